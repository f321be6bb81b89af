"""A heat map of a metric of each class: one line per row, one column per class."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.patches import Rectangle

from framework.data import Float64
from framework.errors import DataError
from framework.figures.figure_page import (
    FAINT_INK,
    HINTED,
    INK,
    MARGIN_MM,
    NOTE_PT,
    SMALL_PT,
    Page,
    text_width,
)
from framework.figures.figure_runs import Pictured
from framework.figures.metric_axes import LINE_MM, Names, page_width, values_of
from framework.runs.run_rows import data_of
from framework.runs.stored_runs import is_number
from framework.tables.metric_columns import SCENENN_NAMES, described

TRUE_COUNT = "instances.true_count."  # prefix of the numbers of ground-truth objects of each class
NAMES_PART = 0.3  # maximum width of the names, relative to the width of the page
CELL_MM = 4.6  # minimum height of a cell
WIDEST_MM = 13.0  # maximum width of a cell
SCALE_MM = 3.0, 12.0  # width of the color scale, and space to its right and left
COLORMAP = "cividis"  # color-blind safe
GAP = "#ffffff"


def class_heatmap(pictured: Pictured) -> Page:
    """Return a page with the mean of the metric of each class for each group. Undefined values are hatched.

    Raises DataError if no run has a metric of a class.
    """
    metric, groups = pictured.choice.shown_metric, pictured.groups
    truths = true_counts(pictured)
    prefix = f"{metric}."
    found = {
        key.removeprefix(prefix) for record in pictured.records for key in record.metrics if key.startswith(prefix)
    }
    classes = sorted(found | set(truths), key=lambda name: (-truths.get(name, 0), name))
    means = np.full((len(groups), len(classes)), np.nan)
    for line, records in zip(means, groups.values(), strict=True):
        for k, name in enumerate(classes):
            if sample := values_of(records, prefix + name):
                line[k] = np.mean(sample)
    if np.isnan(means).all():
        raise DataError(
            f"figure.metric: expected a metric with values of each class, got {metric}; set "
            "figure.metric=instances.ap50 and choose runs with ground-truth instances"
        )
    return _figure(pictured, list(groups), [f"{SCENENN_NAMES.get(n, n)} ({truths.get(n, 0)})" for n in classes], means)


def true_counts(pictured: Pictured) -> dict[str, int]:
    """Return the number of ground-truth objects of each class, summed over the different sequences of the runs."""
    by_data = {data_of(record): record.metrics for record in pictured.records}
    counts: dict[str, int] = {}
    for metrics in by_data.values():
        for key, value in metrics.items():
            if key.startswith(TRUE_COUNT) and is_number(value) and value > 0:
                name = key.removeprefix(TRUE_COUNT)
                counts[name] = counts.get(name, 0) + int(value)
    return counts


def _figure(pictured: Pictured, rows: list[str], classes: list[str], means: Float64) -> Page:
    width = page_width(pictured, default=2)
    names = Names(rows, NAMES_PART * width)
    left = MARGIN_MM + names.width + 1.5
    scale, around = SCALE_MM
    cell = min(WIDEST_MM, (width - left - scale - around) / len(classes))
    size = cell * len(classes), sum(max(CELL_MM, height + 1) for height in names.heights)
    heads = max(text_width(name, SMALL_PT) for name in classes) * HINTED + 2
    note = (
        f"Cells: {described(pictured.choice.shown_metric)} of the class, mean over the runs of each {pictured.unit}. "
        "Hatched: no value. In parentheses: ground-truth objects in all sequences."
    )
    page = Page(width, size[1] + heads + 2 * MARGIN_MM, f"{note} {pictured.origin}")
    axes = page.axes(left, MARGIN_MM, *size)
    colors = colormaps[COLORMAP]
    top = max(1.0, float(np.nanmax(means)))
    bottoms = np.cumsum([max(CELL_MM, height + 1) for height in names.heights])
    for name, line, bottom, above in zip(names.texts, means, bottoms, [0, *bottoms[:-1]], strict=True):
        y = MARGIN_MM + size[1] - (bottom + above) / 2
        page.text(left - 1.5, y, name, ha="right", va="center", fontsize=SMALL_PT, color=INK)
        for k, value in enumerate(line):
            known = np.isfinite(value)
            look: dict[str, Any] = (
                {"fc": colors(value / top)} if known else {"fc": "white", "hatch": "////////", "ec": "#b4b9c0"}
            )
            axes.add_patch(Rectangle((k, above), 1, bottom - above, linewidth=0, **look))
            text = f"{value:.2f}"
            if known and text_width(text, NOTE_PT) * HINTED < cell - 0.4:
                shade = "white" if value / top < 0.55 else "black"
                place = k + 0.5, (bottom + above) / 2
                axes.text(*place, text, ha="center", va="center", fontsize=NOTE_PT, color=shade)
    axes.set(xlim=(0, len(classes)), ylim=(size[1], 0))
    axes.hlines(bottoms[:-1], 0, len(classes), color=GAP, linewidth=0.6)
    axes.vlines(range(1, len(classes)), 0, size[1], color=GAP, linewidth=0.6)
    smallest = min(1.0, (cell * 0.95) / LINE_MM)  # shrinks the headings of many classes
    for k, name in enumerate(classes):
        head = left + (k + 0.5) * cell, MARGIN_MM + size[1] + 1
        page.text(*head, name, rotation=90, ha="center", va="bottom", fontsize=SMALL_PT * smallest, color=INK)
    _draw_scale(page, left + size[0] + 3, size[1], top)
    return page


def _draw_scale(page: Page, left: float, height: float, top: float) -> None:
    """Draw the color scale from 0 to `top`."""
    axes = page.axes(left, MARGIN_MM, SCALE_MM[0], height)
    steps = np.linspace(0, top, 65)
    axes.pcolormesh([0, 1], steps, (steps[:-1, None] + steps[1:, None]) / 2 / top, cmap=COLORMAP, vmin=0, vmax=1)
    axes.yaxis.tick_right()
    axes.set_yticks([0, top / 2, top], [f"{tick:g}" for tick in (0, top / 2, top)])
    axes.tick_params(labelsize=SMALL_PT, width=0.4, length=2, pad=2, color=FAINT_INK, labelcolor=INK)
