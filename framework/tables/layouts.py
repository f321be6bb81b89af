"""How a comparison is laid out: a line a row, and below that each row's differences to the base."""

from __future__ import annotations

import math
from dataclasses import dataclass

from framework.runs.run_rows import Mean
from framework.tables.comparison import ComparisonTable
from framework.tables.grid import TextTable, decimals, figure
from framework.tables.published import NOT_KNOWN, Key, PublishedRow
from framework.tables.sequences import mean_difference
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

NOTHING = "–"  # a figure that is not defined, such as the AP of a class that is not there

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
"""What columns are called; others get the name of their key."""


def head(key: str) -> str:
    """What a figure is called, with its unit."""
    parts = key.split(".")
    if parts[0] == "stage_ms" and len(parts) == 3:
        return f"{parts[1]} (ms{'' if parts[2] == 'median' else f', {parts[2]}'})"
    return HEADS.get(key, key)


def row_grid(comparison: ComparisonTable) -> TextTable:
    """Each row's mean and deviation."""
    rows = comparison.rows
    columns = [_Column([row.mean(key) for row in rows]) for key in comparison.choice.columns]
    body = [
        [
            *(comparison.called(row), str(len(row.records))),
            *(column.cell(k, column.means[k].deviation, len(row.records)) for column in columns),
            row.pose_source,
            *([row.annotation or NOTHING] if comparison.judged else []),
        ]
        for k, row in enumerate(rows)
    ]
    for published in comparison.published_rows:
        cells = [
            published_cell(published, (key,), column.decimals)
            for key, column in zip(comparison.choice.columns, columns, strict=True)
        ]
        annotation = [published.annotation] if comparison.judged else []
        body.append([published_name(published), NOTHING, *cells, published.poses, *annotation])
    heads = ["row", "runs", *map(head, comparison.choice.columns), "poses"] + ["annotation"] * comparison.judged
    return TextTable(heads, body, groups=frozenset({len(rows)}))


def difference_grid(comparison: ComparisonTable) -> TextTable:
    """Each row's mean difference to the base with its standard error."""
    compared = comparison.compared
    columns = [
        _Column([mean_difference(row.differences(base, key)) for row, base in compared])
        for key in comparison.choice.columns
    ]
    body = []
    for k, (row, base) in enumerate(compared):
        pairs = set(row.records) & set(base.records)
        expected = len({run[-1] for run in pairs})
        cells = [column.cell(k, column.means[k].error, expected, signed=True) for column in columns]
        body.append([comparison.called(row), str(len(pairs)), *cells])
    return TextTable([f"less {comparison.base_called}", "pairs", *map(head, comparison.choice.columns)], body)


@dataclass(frozen=True)
class _Column:
    """One figure down the rows, with as many decimals as its largest needs."""

    means: list[Mean]

    @property
    def decimals(self) -> int:
        return decimals(mean.value for mean in self.means)

    def cell(self, k: int, spread: float, expected: int, signed: bool = False) -> str:
        """Mean ± spread; with their number where it is not that of the row's runs."""
        mean = self.means[k]
        if not mean.count:
            return NOTHING
        text = figure(mean.value, spread, self.decimals, signed)
        if signed and mean.is_not_zero:
            text += " *"
        return text if mean.count == expected else f"{text} ({mean.count} of {expected})"


def published_name(published: PublishedRow) -> str:
    return f"{published.system} (published)"


def published_cell(published: PublishedRow, key: Key, digits: int) -> str:
    """The number in a cell; told apart: what nobody has looked up, and what the source does not have."""
    value = (published.values or {}).get(key, math.nan)
    if value is None:
        return NOT_KNOWN
    return NOTHING if math.isnan(value) else figure(value, math.nan, min(digits, published.decimals))
