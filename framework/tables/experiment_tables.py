"""Tables of runs: from the records below a directory to Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path

from framework.files.atomic_write import written_whole
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, latex_grid, markdown_grid
from framework.tables.layouts import difference_grid, row_grid
from framework.tables.sequence_layouts import across_grid, by_grid, difference_across_grid
from framework.tables.sequences import mean_difference
from framework.tables.table_notes import counted, digest, notes


def write_tables(directory: Path) -> str:
    """Writes table.md, table.tex and table.csv into `directory`, from the records below it; returns the Markdown.

    Raises DataError when there is no complete record.
    """
    comparison = ComparisonTable.below(directory)
    text = markdown(comparison)
    separated = comma_separated_runs if comparison.choice.split_key else comma_separated_rows
    for name, content in (("md", text), ("tex", latex(comparison)), ("csv", separated(comparison))):
        with written_whole(directory / f"table.{name}") as temporary:
            temporary.write_text(content, "utf-8")
    return text


def markdown(comparison: ComparisonTable) -> str:
    parts = [f"# {comparison.title}", *map(markdown_grid, grids(comparison))]
    parts.append("\n".join(f"- {note}" for note in notes(comparison)))
    return "\n\n".join(parts) + "\n"


def latex(comparison: ComparisonTable) -> str:
    """Tabulars, with the notes as comments."""
    lines = [f"% {note}" for note in notes(comparison)]
    for grid in grids(comparison):
        lines += latex_grid(grid)
    return "\n".join(lines)


LAYOUTS: dict[str, tuple[Callable[[ComparisonTable], TextTable], Callable[[ComparisonTable], TextTable]]] = {
    "rows": (row_grid, difference_grid),
    "columns_by": (across_grid, difference_across_grid),
    "group_by": (by_grid, difference_grid),
}
"""By TableChoice.layout: the table of the figures, and that of the differences to the base."""


def grids(comparison: ComparisonTable) -> Iterator[TextTable]:
    figures, differences = LAYOUTS[comparison.choice.layout]
    yield figures(comparison)
    if comparison.compared:
        yield differences(comparison)


def comma_separated_rows(comparison: ComparisonTable) -> str:
    """One line a row, all digits; empty where nothing is known."""
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
    """One line a run and figure, all digits, for pandas; a figure that is not defined has no line."""
    split_key = comparison.choice.split_key
    assert split_key
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    origins = ["poses", "tracker", "annotation", "code", "config"]
    writer.writerow(["system", "variant", *comparison.choice.average_over, split_key, "figure", "value", *origins])
    for row in comparison.rows:
        origins_of = {
            run: [
                *(record.metrics.get(key) for key in ("pose_source", "choice.tracker", "annotation_release")),
                *(record.code, record.metrics["config_hash"]),
            ]
            for run, record in row.records.items()
        }
        for column in comparison.choice.columns:
            for run, value in row.values(column).items():
                variant = ", ".join(row.variant)
                writer.writerow([row.system or row.name, variant, *run, column, repr(value), *origins_of[run]])
    return text.getvalue()
