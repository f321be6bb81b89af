"""Tables of the runs below a directory, as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path

from framework.files.atomic_write import atomic_write
from framework.tables.comparison import ComparisonTable, mean_difference
from framework.tables.grid import TextTable, latex_grid, markdown_grid
from framework.tables.layouts import (
    across_grid,
    by_grid,
    difference_across_grid,
    difference_grid,
    row_grid,
    statistics_grid,
)
from framework.tables.table_notes import counted, digest, notes


def write_tables(directory: Path) -> str:
    """Write table.md, table.tex and table.csv of the runs below `directory` into it, and return the Markdown text.

    Raises DataError if no run is complete.
    """
    comparison = ComparisonTable.below(directory)
    grids = list(_grids(comparison))
    explained = list(notes(comparison))
    bullets = "\n".join(f"- {note}" for note in explained)
    text = "\n\n".join([f"# {comparison.title}", *map(markdown_grid, grids), bullets]) + "\n"
    latex = "\n".join([*(f"% {note}" for note in explained), *(line for grid in grids for line in latex_grid(grid))])
    separated = comma_separated_runs if comparison.choice.split_key else comma_separated_rows
    for name, content in (("md", text), ("tex", latex), ("csv", separated(comparison))):
        with atomic_write(directory / f"table.{name}") as temporary:
            temporary.write_text(content, "utf-8")
    return text


LAYOUTS: dict[str, tuple[Callable[[ComparisonTable], TextTable], Callable[[ComparisonTable], TextTable]]] = {
    "rows": (row_grid, difference_grid),
    "columns_by": (across_grid, difference_across_grid),
    "group_by": (by_grid, difference_grid),
}
"""Functions for the table of values and the table of differences from the baseline, by TableChoice.layout."""


def _grids(comparison: ComparisonTable) -> Iterator[TextTable]:
    figures, differences = LAYOUTS[comparison.choice.layout]
    yield figures(comparison)
    if comparison.compared:
        yield differences(comparison)
    if comparison.statistics.tested:
        yield statistics_grid(comparison)


def comma_separated_rows(comparison: ComparisonTable) -> str:
    """Return a CSV table with one line per row, with all digits. Unknown values are empty."""
    statistics = ("mean", "sd", "n", "difference", "se", "pairs")
    keys = [f"{column}.{name}" for column in comparison.choice.columns for name in statistics]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["row", "runs", "poses", "annotation", *keys, "code", "config"])
    for row in comparison.rows:
        line: list[float] = []
        base = row if comparison.base_name in (row.name, row.system) else comparison.base_of(row)
        for column in comparison.choice.columns:
            mean, differences = row.mean(column), row.differences(base, column) if base else {}
            difference = mean_difference(differences)
            line += [mean.value, mean.deviation, mean.count, difference.value, difference.error, len(differences)]
        figures = ["" if math.isnan(x) else repr(x) for x in line]
        records = list(row.records.values())
        code = counted(record.code for record in records)
        writer.writerow([row.name, len(records), row.pose_source, row.annotation, *figures, code, digest(records)])
    return text.getvalue()


def comma_separated_runs(comparison: ComparisonTable) -> str:
    """Return a CSV table with one line per run and metric, with all digits. Undefined metrics have no line."""
    split_key = comparison.choice.split_key
    assert split_key
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    origins = ["poses", "tracker", "annotation", "code", "config"]
    writer.writerow(["system", "variant", *comparison.choice.average_over, split_key, "figure", "value", *origins])
    for row in comparison.rows:
        for column in comparison.choice.columns:
            for run, value in row.values(column).items():
                record = row.records[run]
                origin = [record.metrics.get(f) for f in ("pose_source", "choice.tracker", "annotation_release")]
                origin += [record.code, record.metrics["config_hash"]]
                writer.writerow([row.system or row.name, ", ".join(row.variant), *run, column, repr(value), *origin])
    return text.getvalue()
