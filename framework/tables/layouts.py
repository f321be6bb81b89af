"""Layouts of a comparison: a line per row, a column per sequence, or a group of lines per sequence.

In the layouts with sequences, rows with the same pose source are adjacent, and their highest mean is bold. Means over
fewer runs than the others are not compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from framework.runs.run_rows import Mean, RunRow
from framework.tables.comparison import ComparisonTable, mean_by_sequence, mean_difference, mean_over_sequences
from framework.tables.grid import TextTable, decimals, figure
from framework.tables.published import NOT_KNOWN, Key, PublishedRow
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

NOTHING = "–"  # undefined value, such as the AP of a class without objects
MISSING = "missing"  # value without a complete run

HEADS = {
    "instances.ap": "AP",
    "instances.ap25": "AP25",
    "instances.ap50": "AP50",
    "instances.ap25_agnostic": "AP25 agnostic",
    "instances.ap50_agnostic": "AP50 agnostic",
    "instances.mean_iou": "mean IoU",
    "instances.count": "instances",
    **{
        f"instances.to_map.{key}": f"{name} to map"
        for key, name in (("ap50", "AP50"), ("ap25", "AP25"), ("ap", "AP"), ("mean_iou", "mean IoU"))
    },
    "instances.to_map.ap50_agnostic": "AP50 agnostic, to map",
    "fps": "Hz",
    "fps_median": "Hz (median)",
    "frames_lost": "frames lost",
    "trajectory.ate_rmse_m": "ATE (m)",
    "trajectory.rpe_rmse_m": "RPE (m)",
    "map.bytes": "map (bytes)",
    "peak_rss_bytes": "peak memory (bytes)",
    **{f"instances.ap50.{coco}": name for name, coco in SCENENN_TO_COCO.items()},
}
"""Column headings by key; all other columns have their key as the heading."""


def head(key: str) -> str:
    """Return the heading of a metric's column, with its unit."""
    parts = key.split(".")
    if parts[0] == "stage_ms" and len(parts) == 3:
        return f"{parts[1]} (ms{'' if parts[2] == 'median' else f', {parts[2]}'})"
    return HEADS.get(key, key)


def row_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with the mean and standard deviation of each row, followed by the published rows."""
    keys = comparison.choice.columns
    means = {key: [row.mean(key) for row in comparison.rows] for key in keys}
    digits = {key: decimals(mean.value for mean in of_key) for key, of_key in means.items()}
    lines = [["row", "runs", *map(head, keys), "poses", "annotation"]]
    for k, row in enumerate(comparison.rows):
        cells = [_mean_cell(means[key][k], digits[key], len(row.records)) for key in keys]
        annotation = row.annotation or NOTHING
        lines.append([comparison.called(row), str(len(row.records)), *cells, row.pose_source, annotation])
    for one in comparison.published_rows:
        cells = [published_cell(one, (key,), digits[key]) for key in keys]
        lines.append([published_name(one), NOTHING, *cells, one.poses, one.annotation])
    if not comparison.judged:
        lines = [line[:-1] for line in lines]
    return TextTable(lines[0], lines[1:], groups=frozenset({len(comparison.rows)}))


def difference_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with each row's mean difference from the baseline and its standard error."""
    keys, compared = comparison.choice.columns, comparison.compared
    means = {key: [mean_difference(row.differences(base, key)) for row, base in compared] for key in keys}
    digits = {key: decimals(mean.value for mean in of_key) for key, of_key in means.items()}
    body = []
    for k, (row, base) in enumerate(compared):
        pairs = set(row.records) & set(base.records)
        expected = len({run[-1] for run in pairs})
        texts = [
            _difference(means[key][k], digits[key], comparison.statistics.results[row.name, key].is_significant)
            for key in keys
        ]
        cells = [_of(text, means[key][k].count, expected) for text, key in zip(texts, keys, strict=True)]
        body.append([comparison.called(row), str(len(pairs)), *cells])
    return TextTable([f"minus {comparison.base_called}", "pairs", *map(head, keys)], body)


_Cell = tuple[str, float]  # text and compared value; NaN = not compared


@dataclass(frozen=True)
class _Line:
    labels: list[str]
    cells: list[_Cell]
    variant: tuple[str, ...] = ()  # lines with the same variant are compared


class _SequenceFigures:
    """One metric of all rows as cells, by sequence and averaged over sequences."""

    def __init__(self, comparison: ComparisonTable, key: str) -> None:
        self._rows = comparison.rows
        self._seeds = len({run[:-1] for row in self._rows for run in row.records})  # expected runs of a sequence
        self.means = {row.name: mean_by_sequence(row.values(key)) for row in self._rows}
        self._overall = {row.name: mean_over_sequences(row.values(key)) for row in self._rows}

    @property
    def sequences(self) -> set[str]:
        """Sequences with a value in at least one row."""
        return {sequence for of_row in self.means.values() for sequence in of_row}

    def cell(self, row: RunRow, sequence: str, digits: int) -> _Cell:
        """Return the mean ± standard deviation over seeds, with the number of seeds if values are missing."""
        if not any(run[-1] == sequence for run in row.records):
            return MISSING, math.nan
        mean = self.means[row.name].get(sequence, Mean.of(()))
        found = [self.means[other.name] for other in self._rows if other.variant == row.variant]
        most = max((of_row[sequence].count for of_row in found if sequence in of_row), default=0)
        return _mean_cell(mean, digits, self._seeds), mean.value if mean.count == most else math.nan

    def mean_cell(self, row: RunRow, expected: int, digits: int) -> _Cell:
        """Return the mean ± standard deviation over seeds, with the number of sequences or runs if some are missing."""
        mean = self._overall[row.name]
        others = [self._overall[other.name] for other in self._rows if other.variant == row.variant]
        competes = (mean.count, mean.runs) == max((other.count, other.runs) for other in others)
        text = _of(figure(mean.value, mean.deviation, digits), mean.count, expected)
        if 0 < mean.count == expected and mean.runs < expected * self._seeds:
            text += f" ({mean.runs} of {expected * self._seeds} runs)"
        return text, mean.value if competes else math.nan


def across_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table of each row's means over seeds: one column per sequence, and a column with their mean."""
    [key] = comparison.choice.columns
    figures, sequences = _SequenceFigures(comparison, key), comparison.sequences
    digits = _decimals([figures])
    sections = []
    for rows in _by_variant(comparison.rows):
        section = []
        for row in rows:
            cells = [figures.cell(row, sequence, digits) for sequence in sequences]
            cells.append(figures.mean_cell(row, len(sequences), digits))
            section.append(_row_line(comparison, row, cells))
        sections.append(section)
    keys = [(sequence,) for sequence in (*sequences, "mean")]
    sections.append([_published_line(comparison, one, keys, digits) for one in comparison.published_rows])
    return _grid([*_labels(comparison, "system"), *sequences, "mean"], sections, digits)


def by_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with a group of lines per sequence, and one line per row. The last group contains the means."""
    keys = comparison.choice.columns
    rows = [row for rows in _by_variant(comparison.rows) for row in rows]
    figures = [_SequenceFigures(comparison, key) for key in keys]
    digits = _decimals(figures)
    begun = {run[-1] for row in rows for run in row.records}

    sections: dict[str, list[_Line]] = {}
    for sequence in comparison.sequences:
        known = [one for one in comparison.published_rows if one.knows((sequence, key) for key in keys)]
        sections[sequence] = [
            _row_line(comparison, row, [of_key.cell(row, sequence, digits) for of_key in figures])
            for row in rows
            if sequence in begun
        ] + [_published_line(comparison, one, [(sequence, key) for key in keys], digits) for one in known]
    sections["mean"] = [
        _row_line(comparison, row, [of_key.mean_cell(row, len(of_key.sequences), digits) for of_key in figures])
        for row in rows
    ]
    titled = [
        [replace(line, labels=[title if k == 0 else "", *line.labels]) for k, line in enumerate(section)]
        for title, section in sections.items()
    ]
    return _grid([comparison.noun, *_labels(comparison, "system"), *map(head, keys)], titled, digits)


def difference_across_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table of the baseline minus each other row, by sequence, and their mean with its standard error."""
    [key] = comparison.choice.columns
    differences = {row.name: base.differences(row, key) for row, base in comparison.compared}
    paired = {run[-1] for runs in differences.values() for run in runs}
    sequences = [sequence for sequence in comparison.sequences if sequence in paired]
    digits = decimals(value for runs in differences.values() for value in runs.values())
    sections = []
    for rows in _by_variant([row for row, _ in comparison.compared]):
        section = []
        for row in rows:
            means, mean = mean_by_sequence(differences[row.name]), mean_difference(differences[row.name])
            texts = [figure(means[s].value, math.nan, digits, True) if s in means else MISSING for s in sequences]
            significant = comparison.statistics.results[row.name, key].is_significant
            texts.append(_difference(mean, digits, significant) if mean.count else MISSING)
            texts.append(str(len(differences[row.name])))
            section.append(_row_line(comparison, row, [(text, math.nan) for text in texts]))
        sections.append(section)
    heads = [*_labels(comparison, f"{comparison.base_called} minus"), *sequences, "mean", "pairs"]
    return _grid(heads, sections, digits)


def statistics_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with the statistics of each row and column."""
    base = comparison.base_called
    rows = {row.name: comparison.called(row) for row, _ in comparison.compared}
    return comparison.statistics.grid(
        f"{base} minus" if comparison.choice.columns_by else f"minus {base}",
        rows,
        {key: head(key) for key in comparison.choice.columns},
    )


def _grid(heads: list[str], sections: Sequence[Sequence[_Line]], digits: int) -> TextTable:
    lines: list[_Line] = []
    bold: set[tuple[int, int]] = set()
    groups: set[int] = set()
    for section in sections:
        if lines:
            groups.add(len(lines))
        bold |= {(len(lines) + k, len(section[k].labels) + column) for k, column in _highest(section, digits)}
        lines += section
    body = [[*line.labels, *(text for text, _ in line.cells)] for line in lines]
    return TextTable(heads, body, len(lines[0].labels), frozenset(bold), frozenset(groups))


def _highest(section: Sequence[_Line], digits: int) -> Iterator[tuple[int, int]]:
    """Yield the (line, column) of each highest printed value among the lines of a variant."""
    for k, line in enumerate(section):
        competing = [other.cells for other in section if other.variant == line.variant]
        for column, (_, value) in enumerate(line.cells):
            values = [round(cells[column][1], digits) for cells in competing if not math.isnan(cells[column][1])]
            if len(values) > 1 and round(value, digits) == max(values):
                yield k, column


def _decimals(figures: Iterable[_SequenceFigures]) -> int:
    return decimals(mean.value for f in figures for of_row in f.means.values() for mean in of_row.values())


def _by_variant(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """Return groups of comparable rows, in the order of the first row of each group."""
    groups: dict[tuple[str, ...], list[RunRow]] = {}
    for row in rows:
        groups.setdefault(row.variant, []).append(row)
    return list(groups.values())


def _labels(comparison: ComparisonTable, name: str, poses: str = "poses", annotation: str = "annotation") -> list[str]:
    """Return the first cells of a line or of the headings: a name, poses and annotation."""
    return [name, poses, annotation] if comparison.judged else [name, poses]


def _row_line(comparison: ComparisonTable, row: RunRow, cells: list[_Cell]) -> _Line:
    name = comparison.called(row, without="tracker")
    return _Line(_labels(comparison, name, row.poses, row.annotation or NOTHING), cells, row.variant)


def _published_line(comparison: ComparisonTable, one: PublishedRow, keys: Iterable[Key], digits: int) -> _Line:
    labels = _labels(comparison, published_name(one), one.poses, one.annotation)
    return _Line(labels, [(published_cell(one, key, digits), math.nan) for key in keys])


def published_name(published: PublishedRow) -> str:
    """Return the name of a published row."""
    return f"{published.system} (published)"


def published_cell(published: PublishedRow, key: Key, digits: int) -> str:
    """Return a published number as text; NOT_KNOWN = not looked up, NOTHING = not in the source."""
    value = (published.values or {}).get(key, math.nan)
    if value is None:
        return NOT_KNOWN
    return NOTHING if math.isnan(value) else figure(value, math.nan, min(digits, published.decimals))


def _mean_cell(mean: Mean, digits: int, expected: int) -> str:
    return _of(figure(mean.value, mean.deviation, digits), mean.count, expected)


def _difference(mean: Mean, digits: int, significant: bool) -> str:
    """Return the signed mean ± standard error; * = significantly different from 0."""
    text = figure(mean.value, mean.error, digits, signed=True)
    return f"{text} *" if significant else text


def _of(text: str, count: int, expected: int) -> str:
    """Return the text, with the count appended if it differs from the expected count."""
    if not count:
        return NOTHING
    return text if count == expected else f"{text} ({count} of {expected})"
