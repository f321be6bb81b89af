"""Tables of the runs below a directory, as Markdown, LaTeX and CSV."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from framework.files.atomic_write import atomic_write
from framework.runs.data_frame import data_frame
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, latex_grid, markdown_grid
from framework.tables.layouts import (
    across_grid,
    by_grid,
    difference_across_grid,
    difference_grid,
    row_grid,
    statistics_grid,
)
from framework.tables.table_notes import notes


def write_tables(directory: Path) -> str:
    """Write table.md, table.tex and table.csv of the runs below `directory` into it, and return the Markdown text.

    table.csv is the data frame of the runs in the table (`load_runs`). Raises DataError if no run is complete, and
    ConfigError for an invalid table.
    """
    tables = rendered_tables(directory)
    for name, content in tables.items():
        with atomic_write(directory / name) as temporary:
            temporary.write_text(content, "utf-8")
    return tables["table.md"]


def rendered_tables(directory: Path) -> dict[str, str]:
    """Return the contents of table.md, table.tex and table.csv as in `write_tables`, by file name."""
    comparison = ComparisonTable.below(directory)
    grids = list(_grids(comparison))
    explained = list(notes(comparison))
    bullets = "\n".join(f"- {note}" for note in explained)
    text = "\n\n".join([f"# {comparison.title}", *map(markdown_grid, grids), bullets]) + "\n"
    latex = "\n".join([*(f"% {note}" for note in explained), *(line for grid in grids for line in latex_grid(grid))])
    runs = sorted(comparison.records, key=lambda record: record.directory)
    separated = data_frame(runs, directory).to_csv(index=False, lineterminator="\n")
    return {"table.md": text, "table.tex": latex, "table.csv": separated}


LAYOUTS: dict[str, tuple[Callable[[ComparisonTable], TextTable], Callable[[ComparisonTable], TextTable]]] = {
    "rows": (row_grid, difference_grid),
    "columns_by": (across_grid, difference_across_grid),
    "group_by": (by_grid, difference_grid),
}
"""Functions for the table of values and the table of differences from the base, by TableChoice.layout."""


def _grids(comparison: ComparisonTable) -> Iterator[TextTable]:
    figures, differences = LAYOUTS[comparison.choice.layout]
    yield figures(comparison)
    if comparison.compared:
        yield differences(comparison)
    if comparison.statistics.tested:
        yield statistics_grid(comparison)
