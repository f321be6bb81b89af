"""Comparison of stored tables with the stored runs."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.runs.stored_runs import read_yaml
from framework.tables.experiment_tables import SETTINGS, rendered_tables

TABLE_FORMATS = (".md", ".tex", ".csv")

Grid = list[list[str]]  # cells of each line of a table; the first line contains the headings


def changed_tables(directory: Path) -> Iterator[str]:
    """Yield one message for each table cell that differs from the stored runs.

    A table with different rows or columns has a single message. The tables are table.md, table.tex and table.csv.
    Captions and notes are not compared.

    Args:
        directory: The folder of the tables. The runs are in this folder and its subfolders.

    Raises:
        DataError: No run is complete, or a table cannot be read.
        ConfigError: The sweep in `directory` has an invalid table.
    """
    stored = [path for path in (directory / f"table{suffix}" for suffix in TABLE_FORMATS) if path.exists()]
    if not stored:
        return
    settings = read_yaml(directory / SETTINGS) if (directory / SETTINGS).exists() else {}
    rendered = rendered_tables(directory, list(map(str, settings.get("overrides") or ())))
    for path in stored:
        expected, found = (_grids(path, text) for text in (rendered[path.name], read_text(path)))
        if _shape(expected) != _shape(found):
            rewrite = f"run instancemap tables {shlex.quote(str(directory))}"
            yield f"{path}: expected the rows and columns of the runs' table, got different ones; {rewrite}"
            continue
        for grid, stored_grid in zip(expected, found, strict=True):
            for line, stored_line in zip(grid, stored_grid, strict=True):
                for head, cell, stored_cell in zip(grid[0], line, stored_line, strict=False):
                    if cell != stored_cell:
                        yield f"{path}: {line[0]}: {head}: expected {cell} as in the runs, got {stored_cell}"


def _shape(grids: list[Grid]) -> list[list[int]]:
    return [list(map(len, grid)) for grid in grids]


def _grids(path: Path, text: str) -> list[Grid]:
    """Return the cells of the tables in a file."""
    if path.suffix == ".csv":
        try:
            return [list(csv.reader(text.splitlines()))]
        except csv.Error as error:
            raise DataError(f"{path}: expected valid CSV, got an error ({error})") from error
    rule, separator = ("| --", "|") if path.suffix == ".md" else ("\\midrule", "&")
    lines = (line for line in text.splitlines() if not line.startswith((rule, "%")))
    tables = (list(table) for is_table, table in groupby(lines, lambda line: separator in line) if is_table)
    return [[[cell.strip(" |\\") for cell in line.split(f" {separator} ")] for line in table] for table in tables]
