"""Tables of the runs below a directory, as Markdown, LaTeX and CSV."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from omegaconf import OmegaConf

from framework.files.atomic_write import atomic_write
from framework.runs.data_frame import data_frame, without_formulas
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, markdown_page
from framework.tables.latex_captions import CAPTIONS, DIFFERENCES, STATISTICS, VALUES
from framework.tables.latex_table import LatexTable, latex_file, latex_label
from framework.tables.layouts import (
    across_grid,
    by_grid,
    difference_across_grid,
    difference_grid,
    row_grid,
    statistics_grid,
)
from framework.tables.table_notes import notes

SETTINGS = "table.yaml"  # overrides of the stored tables; exists only with overrides


def write_tables(directory: Path, overrides: Sequence[str] = ()) -> str:
    """Write table.md, table.tex and table.csv of the runs below a folder, and return the Markdown text.

    table.tex is for a paper. table.csv is the data frame of the runs in the table (`load_runs`).

    Args:
        directory: The folder. The runs are in this folder and its subfolders.
        overrides: Changed settings of the table, such as table.base=chain. They are stored in table.yaml.

    Raises:
        DataError: No run is complete.
        ConfigError: The table is invalid.
    """
    tables = rendered_tables(directory, overrides)
    for name, content in tables.items():
        with atomic_write(directory / name) as temporary:
            temporary.write_text(content, "utf-8")
    if overrides:
        with atomic_write(directory / SETTINGS) as temporary:
            OmegaConf.save({"overrides": list(overrides)}, temporary)
    else:
        (directory / SETTINGS).unlink(missing_ok=True)
    return tables["table.md"]


def rendered_tables(directory: Path, overrides: Sequence[str] = ()) -> dict[str, str]:
    """Return the contents of table.md, table.tex and table.csv as in `write_tables`, by file name."""
    comparison = ComparisonTable.below(directory, overrides)
    grids = dict(_grids(comparison))
    explained = list(notes(comparison))
    text = markdown_page(comparison.title, grids.values(), explained)
    latex = latex_file([_latex_table(comparison, name, grid) for name, grid in grids.items()], explained)
    runs = sorted(comparison.records, key=lambda record: record.directory)
    separated = without_formulas(data_frame(runs, directory)).to_csv(index=False, lineterminator="\n")
    return {"table.md": text, "table.tex": latex, "table.csv": separated}


LAYOUTS: dict[str, tuple[Callable[[ComparisonTable], TextTable], Callable[[ComparisonTable], TextTable]]] = {
    "rows": (row_grid, difference_grid),
    "columns_by": (across_grid, difference_across_grid),
    "group_by": (by_grid, difference_grid),
}
"""Functions for the table of values and the table of differences from the base, by TableChoice.layout."""


def _grids(comparison: ComparisonTable) -> Iterator[tuple[str, TextTable]]:
    """Yield the tables, each with a key of CAPTIONS."""
    figures, differences = LAYOUTS[comparison.choice.layout]
    yield VALUES, figures(comparison)
    if comparison.compared:
        yield DIFFERENCES, differences(comparison)
    if comparison.statistics.tested:
        yield STATISTICS, statistics_grid(comparison)


def _latex_table(comparison: ComparisonTable, name: str, grid: TextTable) -> LatexTable:
    choice = comparison.choice
    label = choice.label or latex_label(comparison.title)
    if name != VALUES:
        return LatexTable(grid, CAPTIONS[name](comparison), f"{label}-{name}", choice.page_columns)
    return LatexTable(grid, choice.caption or CAPTIONS[name](comparison), label, choice.page_columns)
