"""Layouts of a comparison: one column per metric, one column per sequence, or one group of rows per sequence.

In the layouts with sequences, rows with the same pose source are adjacent, and the best mean among them is bold unless
several rows have it. Means over fewer runs than the others are not compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from framework.runs.run_rows import Mean, RunRow
from framework.tables.comparison import ComparisonTable, mean_by_sequence, mean_over_sequences
from framework.tables.grid import TextTable, decimals, figure
from framework.tables.metric_columns import Direction, direction, head
from framework.tables.published import NOT_KNOWN, Key, PublishedRow

NOTHING = "–"  # undefined value, such as the AP of a class without objects
MISSING = "missing"  # value without a complete run


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
    return TextTable(lines[0], lines[1:], groups=frozenset({len(comparison.rows)}), directions=_directions(keys, 2))


def difference_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with each row's mean difference from its base and its standard error."""
    keys, compared = comparison.choice.columns, comparison.compared
    means = {key: [comparison.difference(row, base, key) for row, base in compared] for key in keys}
    digits = {key: decimals(mean.value for mean in of_key) for key, of_key in means.items()}
    body = []
    for k, (row, base) in enumerate(compared):
        pairs = len(comparison.common_units(row, base))
        cells = []
        for key in keys:
            significant = comparison.statistics.results[row.name, key].is_significant
            cells.append(_of(_difference(means[key][k], digits[key], significant), means[key][k].count, pairs))
        body.append([comparison.called(row), str(pairs), *cells])
    heads = [f"minus {comparison.base_called}", "pairs", *map(head, keys)]
    return TextTable(heads, body, directions=_directions(keys, 2))


def _directions(keys: Sequence[str], first: int) -> dict[int, Direction]:
    """Return the direction of each metric by its column; the metrics begin in the column `first`."""
    return {first + k: direction(key) for k, key in enumerate(keys)}


_Cell = tuple[str, float]  # text and compared value; NaN = not compared


@dataclass(frozen=True)
class _Line:
    """A line of a table with sequences."""

    labels: list[str]
    cells: list[_Cell]
    peers: tuple[str, ...] = ()  # RunRow.peers; lines with the same value are compared


class _SequenceFigures:
    """One metric of all rows as cells, by sequence and averaged over sequences."""

    def __init__(self, comparison: ComparisonTable, key: str) -> None:
        self._rows = comparison.rows
        self.direction = direction(key)
        self.means = {row.name: mean_by_sequence(row.values(key)) for row in self._rows}
        self._overall = {row.name: mean_over_sequences(row.values(key)) for row in self._rows}
        self._expected = {sequence: comparison.expected(sequence) for sequence in self.sequences}
        self.digits = decimals(mean.value for of_row in self.means.values() for mean in of_row.values())

    @property
    def sequences(self) -> set[str]:
        """Sequences with a value in at least one row."""
        return {sequence for of_row in self.means.values() for sequence in of_row}

    def cell(self, row: RunRow, sequence: str) -> _Cell:
        """Return the mean ± standard deviation over the seeds of one sequence.

        The number of seeds is appended if values are missing.
        """
        if not any(run[-1] == sequence for run in row.records):
            return MISSING, math.nan
        mean = self.means[row.name].get(sequence, Mean.of(()))
        found = [self.means[other.name] for other in self._rows if other.peers == row.peers]
        most = max((of_row[sequence].count for of_row in found if sequence in of_row), default=0)
        text = _mean_cell(mean, self.digits, self._expected.get(sequence, 0))
        return text, mean.value if mean.count == most else math.nan

    def mean_cell(self, row: RunRow, sequences: int) -> _Cell:
        """Return the mean over sequences ± standard deviation over seeds.

        The number of sequences or runs is appended if some of the expected `sequences` or of their runs are missing.
        """
        mean = self._overall[row.name]
        others = [self._overall[other.name] for other in self._rows if other.peers == row.peers]
        competes = (mean.count, mean.runs) == max((other.count, other.runs) for other in others)
        equal_runs = all(of_sequence.deviation == 0 for of_sequence in self.means[row.name].values())
        spread = math.nan if equal_runs else mean.deviation
        text = _of(figure(mean.value, spread, self.digits), mean.count, sequences)
        runs = sum(self._expected.values())
        if 0 < mean.count == sequences and mean.runs < runs:
            text += f" ({mean.runs} of {runs} runs)"
        return text, mean.value if competes else math.nan


def across_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table of the means of each row over seeds, with one column per sequence and a column with their mean."""
    [key] = comparison.choice.columns
    figures, sequences = _SequenceFigures(comparison, key), comparison.sequences
    sections = []
    for rows in _by_peers(comparison.rows):
        section = []
        for row in rows:
            cells = [figures.cell(row, sequence) for sequence in sequences]
            cells.append(figures.mean_cell(row, len(sequences)))
            section.append(_row_line(comparison, row, cells))
        sections.append(section)
    keys = [(sequence,) for sequence in (*sequences, "mean")]
    columns = [figures] * len(keys)
    sections.append([_published_line(comparison, one, keys, columns) for one in comparison.published_rows])
    return _grid([*_labels(comparison, "system"), *sequences, "mean"], sections, columns)


def by_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with one group of rows per sequence. The last group contains the means."""
    keys = comparison.choice.columns
    rows = [row for rows in _by_peers(comparison.rows) for row in rows]
    figures = [_SequenceFigures(comparison, key) for key in keys]
    begun = {run[-1] for row in rows for run in row.records}

    sections: dict[str, list[_Line]] = {}
    for sequence in comparison.sequences:
        known = [one for one in comparison.published_rows if one.has_any((sequence, key) for key in keys)]
        sections[sequence] = [
            _row_line(comparison, row, [of_key.cell(row, sequence) for of_key in figures])
            for row in rows
            if sequence in begun
        ] + [_published_line(comparison, one, [(sequence, key) for key in keys], figures) for one in known]
    sections["mean"] = [
        _row_line(comparison, row, [of_key.mean_cell(row, len(of_key.sequences)) for of_key in figures]) for row in rows
    ]
    titled = [
        [replace(line, labels=[title if k == 0 else "", *line.labels]) for k, line in enumerate(section)]
        for title, section in sections.items()
    ]
    labels = [comparison.noun, *_labels(comparison, "system")]
    grid = _grid([*labels, *map(head, keys)], titled, figures)
    return replace(grid, directions=_directions(keys, len(labels)))


def difference_across_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table of the base minus each other row, by sequence, and their mean with its standard error."""
    [key] = comparison.choice.columns
    bases = {row.name: base for row, base in comparison.compared}
    differences = {row.name: comparison.difference_by_sequence(base, row, key) for row, base in comparison.compared}
    sequences = [sequence for sequence in comparison.sequences if any(sequence in one for one in differences.values())]
    digits = decimals(value for of_row in differences.values() for value in of_row.values())
    sections = []
    for rows in _by_peers([row for row, _ in comparison.compared]):
        section = []
        for row in rows:
            of_row, mean = differences[row.name], comparison.difference(bases[row.name], row, key)
            texts = [figure(of_row[s], math.nan, digits, True) if s in of_row else MISSING for s in sequences]
            significant = comparison.statistics.results[row.name, key].is_significant
            texts += [_difference(mean, digits, significant) if mean.count else MISSING, str(mean.count)]
            section.append(_row_line(comparison, row, [(text, math.nan) for text in texts]))
        sections.append(section)
    heads = [*_labels(comparison, f"{comparison.base_called} minus"), *sequences, "mean", "pairs"]
    return _grid(heads, sections)


def statistics_grid(comparison: ComparisonTable) -> TextTable:
    """Return a table with the statistics of each row and column."""
    base = comparison.base_called
    rows = {row.name: comparison.called(row) for row, _ in comparison.compared}
    return comparison.statistics.grid(
        f"{base} minus" if comparison.choice.columns_by else f"minus {base}",
        rows,
        {key: head(key) for key in comparison.choice.columns},
    )


def _grid(heads: list[str], sections: Sequence[Sequence[_Line]], columns: Sequence[_SequenceFigures] = ()) -> TextTable:
    """Return the sections as a table. The best values of `columns` are bold."""
    lines: list[_Line] = []
    bold: set[tuple[int, int]] = set()
    groups: set[int] = set()
    for section in sections:
        if lines:
            groups.add(len(lines))
        for column, figures in enumerate(columns):
            best = _best(section, column, figures.direction, figures.digits)
            bold |= {(len(lines) + k, len(section[k].labels) + column) for k in best}
        lines += section
    body = [[*line.labels, *(text for text, _ in line.cells)] for line in lines]
    return TextTable(heads, body, len(lines[0].labels), frozenset(bold), frozenset(groups))


def _best(section: Sequence[_Line], column: int, better: Direction, digits: int) -> Iterator[int]:
    """Yield the line of the best printed value of a column among comparable lines, unless it is a tie."""
    if better is Direction.NONE:
        return
    for k, line in enumerate(section):
        competing = [other.cells[column][1] for other in section if other.peers == line.peers]
        values = [round(better * value, digits) for value in competing if not math.isnan(value)]
        own = round(better * line.cells[column][1], digits)
        if len(values) > 1 and own == max(values) and values.count(own) == 1:
            yield k


def _by_peers(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """Return groups of comparable rows, in the order of the first row of each group."""
    groups: dict[tuple[str, ...], list[RunRow]] = {}
    for row in rows:
        groups.setdefault(row.peers, []).append(row)
    return list(groups.values())


def _labels(comparison: ComparisonTable, name: str, poses: str = "poses", annotation: str = "annotation") -> list[str]:
    """Return the first cells of a line or of the headings: a name, poses and annotation."""
    return [name, poses, annotation] if comparison.judged else [name, poses]


def _row_line(comparison: ComparisonTable, row: RunRow, cells: list[_Cell]) -> _Line:
    name = comparison.called(row, without="tracker")
    return _Line(_labels(comparison, name, row.poses, row.annotation or NOTHING), cells, row.peers)


def _published_line(
    comparison: ComparisonTable, one: PublishedRow, keys: Iterable[Key], columns: Iterable[_SequenceFigures]
) -> _Line:
    labels = _labels(comparison, published_name(one), one.poses, one.annotation)
    cells = [published_cell(one, key, of_key.digits) for key, of_key in zip(keys, columns, strict=True)]
    return _Line(labels, [(cell, math.nan) for cell in cells])


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
    return _of(figure(mean.value, mean.deviation or math.nan, digits), mean.count, expected)


def _difference(mean: Mean, digits: int, significant: bool) -> str:
    """Return the signed mean ± standard error; * = significantly different from 0."""
    text = figure(mean.value, mean.error or math.nan, digits, signed=True)
    return f"{text} *" if significant else text


def _of(text: str, count: int, expected: int) -> str:
    """Return the text, with the count appended if it differs from the expected count; NOTHING if the count is 0."""
    if not count:
        return NOTHING
    return text if count == expected else f"{text} ({count} of {expected})"
