"""How a comparison over sequences is laid out: a column for each sequence, or a group of lines for each.

Lines of the same poses stand together, and the highest figure among them is in bold: of those that are means of as many
runs as the others, as one seed may be luckier than the mean of three.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from framework.runs.run_rows import Mean, RunRow
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, decimals, figure
from framework.tables.layouts import NOTHING, head, published_cell, published_name
from framework.tables.published import PublishedRow
from framework.tables.sequences import SequenceMean, mean_by_sequence, mean_difference, mean_over_sequences

MISSING = "missing"  # a figure that a run would have, of which there is no complete record


@dataclass(frozen=True)
class _Line:
    labels: list[str]
    cells: list[str]
    variant: tuple[str, ...] | None = None  # lines that share it compete for the highest; None = competes with none
    figures: Sequence[float] = ()  # for each cell; NaN = does not compete


def across_grid(comparison: ComparisonTable) -> TextTable:
    """A column a sequence: each row's mean over seeds there, and the mean of these."""
    [key] = comparison.choice.columns
    sequences, seeds = comparison.sequences, _seeds(comparison)
    means = {row.name: mean_by_sequence(row.values(key)) for row in comparison.rows}
    overall = {row.name: mean_over_sequences(row.values(key)) for row in comparison.rows}
    digits = decimals(mean.value for found in means.values() for mean in found.values())
    sections = [
        [
            _Line(
                _row_labels(comparison, row),
                [
                    *(_cell(row, means[row.name], sequence, seeds, digits) for sequence in sequences),
                    _mean_cell(overall[row.name], len(sequences), seeds, digits),
                ],
                row.variant,
                [*(_comparable(row, rows, means, s) for s in sequences), _comparable_mean(row, rows, overall)],
            )
            for row in rows
        ]
        for rows in _by_variant(comparison.rows)
    ]
    published = [
        _Line(
            _published_labels(comparison, one),
            [
                *(published_cell(one, (sequence,), digits) for sequence in sequences),
                NOTHING,  # a mean that nobody has published
            ],
        )
        for one in comparison.published_rows
    ]
    return _grid([*_label_heads(comparison, "system"), *sequences, "mean"], [*sections, published], digits)


def by_grid(comparison: ComparisonTable) -> TextTable:
    """A group of lines a sequence, each line a row with all of its figures; the last group are their means."""
    keys, seeds = comparison.choice.columns, _seeds(comparison)
    rows = [row for rows in _by_variant(comparison.rows) for row in rows]
    means = {key: {row.name: mean_by_sequence(row.values(key)) for row in rows} for key in keys}
    overall = {key: {row.name: mean_over_sequences(row.values(key)) for row in rows} for key in keys}
    found_in = {key: len({sequence for found in means[key].values() for sequence in found}) for key in keys}
    digits = decimals(mean.value for of_key in means.values() for found in of_key.values() for mean in found.values())
    begun = {run[-1] for row in rows for run in row.records}
    sections: dict[str, list[_Line]] = {}
    for sequence in comparison.sequences:
        sections[sequence] = [
            _Line(
                _row_labels(comparison, row),
                [_cell(row, means[key][row.name], sequence, seeds, digits) for key in keys],
                row.variant,
                [_comparable(row, rows, means[key], sequence) for key in keys],
            )
            for row in (rows if sequence in begun else ())
        ] + [
            _Line(_published_labels(comparison, one), [published_cell(one, (sequence, key), digits) for key in keys])
            for one in comparison.published_rows
            if one.knows((sequence, key) for key in keys)
        ]
    sections["mean"] = [
        _Line(
            _row_labels(comparison, row),
            [_mean_cell(overall[key][row.name], found_in[key], seeds, digits) for key in keys],
            row.variant,
            [_comparable_mean(row, rows, overall[key]) for key in keys],
        )
        for row in rows
    ]
    titled = [
        [replace(line, labels=[title if k == 0 else "", *line.labels]) for k, line in enumerate(section)]
        for title, section in sections.items()
    ]
    return _grid([comparison.noun, *_label_heads(comparison, "system"), *map(head, keys)], titled, digits)


def difference_across_grid(comparison: ComparisonTable) -> TextTable:
    """The base less each of the others, sequence by sequence, and the mean with its standard error."""
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
            cells = [figure(means[s].value, math.nan, digits, True) if s in means else MISSING for s in sequences]
            overall = figure(mean.value, mean.error, digits, True) if mean.count else MISSING
            cells += [f"{overall} *" if mean.is_not_zero else overall, str(len(differences[row.name]))]
            section.append(_Line(_row_labels(comparison, row), cells))
        sections.append(section)
    heads = [*_label_heads(comparison, f"{comparison.base_called} less"), *sequences, "mean", "pairs"]
    return _grid(heads, sections, digits)


def _grid(heads: list[str], sections: Sequence[Sequence[_Line]], digits: int) -> TextTable:
    lines: list[_Line] = []
    bold: set[tuple[int, int]] = set()
    groups: set[int] = set()
    for section in sections:
        if lines:
            groups.add(len(lines))
        bold |= {(len(lines) + k, len(line.labels) + column) for k, line, column in _highest(section, digits)}
        lines += section
    label_columns = len(lines[0].labels)
    return TextTable(
        heads, [[*line.labels, *line.cells] for line in lines], label_columns, frozenset(bold), frozenset(groups)
    )


def _highest(section: Sequence[_Line], digits: int) -> Iterable[tuple[int, _Line, int]]:
    """(index, line, column) of the figures that no rival's exceeds as it is printed; without a rival there is none."""
    for k, line in enumerate(section):
        if line.variant is None:
            continue
        rivals = [other.figures for other in section if other.variant == line.variant]
        for column, value in enumerate(line.figures):
            others = [round(figures[column], digits) for figures in rivals if not math.isnan(figures[column])]
            if len(others) > 1 and round(value, digits) == max(others):
                yield k, line, column


def _by_variant(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """The rows in groups of those that can be compared, in the order of each group's first."""
    groups: dict[tuple[str, ...], list[RunRow]] = {}
    for row in rows:
        groups.setdefault(row.variant, []).append(row)
    return list(groups.values())


def _labels(comparison: ComparisonTable, name: str, poses: str, annotation: str) -> list[str]:
    """What a line, or the head, begins with: a name and what may not be averaged."""
    return [name, poses, annotation] if comparison.judged else [name, poses]


def _row_labels(comparison: ComparisonTable, row: RunRow) -> list[str]:
    return _labels(comparison, comparison.called(row, without="tracker"), row.poses, row.annotation or NOTHING)


def _published_labels(comparison: ComparisonTable, one: PublishedRow) -> list[str]:
    return _labels(comparison, published_name(one), one.poses, one.annotation)


def _label_heads(comparison: ComparisonTable, name: str) -> list[str]:
    return _labels(comparison, name, "poses", "annotation")


def _seeds(comparison: ComparisonTable) -> int:
    """How many runs a row should have in a sequence."""
    return len({run[:-1] for row in comparison.rows for run in row.records})


def _comparable(row: RunRow, rows: Sequence[RunRow], means: Mapping[str, Mapping[str, Mean]], sequence: str) -> float:
    """A row's mean in a sequence; NaN for that of fewer runs than a row has there that it competes with."""
    rivals = [means[other.name] for other in rows if other.variant == row.variant]
    most = max((found[sequence].count for found in rivals if sequence in found), default=0)
    mean = means[row.name].get(sequence)
    return mean.value if mean and mean.count == most else math.nan


def _comparable_mean(row: RunRow, rows: Sequence[RunRow], means: Mapping[str, SequenceMean]) -> float:
    """A row's mean; NaN for that of fewer sequences, or fewer runs of as many, than a row has that it competes with."""
    most = max((means[other.name].count, means[other.name].runs) for other in rows if other.variant == row.variant)
    mean = means[row.name]
    return mean.value if (mean.count, mean.runs) == most else math.nan


def _cell(row: RunRow, means: Mapping[str, Mean], sequence: str, seeds: int, digits: int) -> str:
    """Mean ± deviation over seeds; with their number where a run is missing or has no such figure."""
    if not any(run[-1] == sequence for run in row.records):
        return MISSING
    if sequence not in means:
        return NOTHING
    mean = means[sequence]
    return _of(figure(mean.value, mean.deviation, digits), mean.count, seeds)


def _mean_cell(mean: SequenceMean, expected: int, seeds: int, digits: int) -> str:
    """Mean ± deviation over seeds; with the number of sequences where some are missing, else of runs where some are."""
    if not mean.count:
        return NOTHING
    text = figure(mean.value, mean.deviation, digits)
    if mean.count == expected and mean.runs < expected * seeds:
        return f"{text} ({mean.runs} of {expected * seeds} runs)"
    return _of(text, mean.count, expected)


def _of(text: str, count: int, expected: int) -> str:
    return text if count == expected else f"{text} ({count} of {expected})"
