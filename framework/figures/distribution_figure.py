"""Bars and boxes of a metric: one per row or value of a key, optionally in one color per value of a second key."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes

from framework.figures.figure_page import FAINT_INK, HINTED, INK, MARGIN_MM, NOTE_PT, SMALL_PT, Page, text_width
from framework.figures.figure_runs import Pictured
from framework.figures.metric_axes import (
    Legend,
    Names,
    Style,
    bar,
    check_metrics,
    mixed,
    page_width,
    style_axes,
    styles,
    values_of,
)
from framework.runs.run_rows import CONFIDENCE
from framework.tables.metric_columns import described
from framework.tables.statistics import MIN_UNITS, bootstrap_interval

BAR_MM, GAP_MM = 3.4, 2.0  # height of a bar or box, and space between groups
AXIS_MM = 6.5  # height of the axis labels
NAMES_PART = 0.38  # maximum width of the names, relative to the width of the page
BOX_PART = 0.7  # height of a bar or box, relative to BAR_MM
POINTS_PART = 0.4  # height of the points of a bar, relative to BAR_MM

Draw = Callable[[Axes, float, Sequence[float], Style], None]


def bar_figure(pictured: Pictured) -> Page:
    """Return a page with the mean of the metric, its runs and its bootstrap interval for each group.

    Raises DataError if no run has the metric.
    """
    note = (
        f"Bars: mean over the runs of each {pictured.unit}. Points: runs. Black lines: {CONFIDENCE:.0%} bootstrap "
        f"interval (BCa) of the mean over at least {MIN_UNITS} runs."
    )
    return _figure(pictured, _draw_bar, note)


def box_figure(pictured: Pictured) -> Page:
    """Return a page with the quartiles of the metric and its runs for each group.

    Raises DataError if no run has the metric.
    """
    note = (
        f"Boxes: quartiles with the median, for each {pictured.unit}. Whiskers: farthest run within 1.5 times the "
        "interquartile range. Points: runs."
    )
    return _figure(pictured, _draw_box, note)


def _figure(pictured: Pictured, draw: Draw, note: str) -> Page:
    metric, groups, colors = pictured.choice.shown_metric, pictured.groups, pictured.colors
    check_metrics(pictured, metric)
    runs = [[pictured.of_color(records, color) for color in colors] for records in groups.values()]
    values = [[values_of(records, metric) for records in of_group] for of_group in runs]

    width = page_width(pictured)
    names = Names(list(groups), NAMES_PART * width)
    counts = [[f"n = {len(sample)}" for sample in of_group] for of_group in values]
    left = MARGIN_MM + names.width + 1.5
    right = max(text_width(text, NOTE_PT) * HINTED for of_group in counts for text in of_group) + 2 * MARGIN_MM
    heights = [max(name, len(colors) * BAR_MM) + GAP_MM for name in names.heights]
    size = width - left - right, sum(heights)
    legend = Legend(pictured.color_names, width - left - right)
    varied = pictured.varied(records for of_group in runs for records in of_group)
    differing = f" Runs of one {pictured.choice.kind} differ in {', '.join(varied)}." if varied else ""
    page = Page(width, AXIS_MM + size[1] + legend.height + MARGIN_MM, f"{note} n: runs.{differing} {pictured.origin}")
    legend.draw(page, left, AXIS_MM + size[1] + legend.height)
    axes = page.axes(left, AXIS_MM, *size)
    top = 0.0
    for name, height, of_group, texts in zip(names.texts, heights, values, counts, strict=True):
        middle = top + height / 2
        page.text(left - 1.5, AXIS_MM + size[1] - middle, name, ha="right", va="center", fontsize=SMALL_PT, color=INK)
        for k, (sample, text, style) in enumerate(zip(of_group, texts, styles(len(colors)), strict=True)):
            y = middle + (k - (len(colors) - 1) / 2) * BAR_MM
            if sample:
                draw(axes, y, sample, style)
            right_of = left + size[0] + MARGIN_MM, AXIS_MM + size[1] - y
            page.text(*right_of, text, va="center", fontsize=NOTE_PT, color=FAINT_INK)
        top += height
    axes.set_ylim(size[1], 0)
    if axes.get_xlim()[0] >= 0:
        axes.set_xlim(left=0)
    style_axes(axes, described(metric), "", "x")
    axes.set_yticks([])
    return page


def _draw_bar(axes: Axes, y: float, sample: Sequence[float], style: Style) -> None:
    """Draw the bar of a group, centered at `y` mm."""
    height = BOX_PART * BAR_MM
    mean = float(np.mean(sample))
    axes.add_patch(bar((0, y - height / 2), mean, height, style, 0.55))
    axes.update_datalim([(0, y), (mean, y)])
    _draw_points(axes, y, sample, style)
    low, high = bootstrap_interval(np.sort(sample))
    if not math.isnan(low):
        axes.errorbar(mean, y, xerr=[[mean - low], [high - mean]], color="black", elinewidth=0.8, capsize=1.2, zorder=4)
    axes.autoscale_view(scaley=False)


def _draw_box(axes: Axes, y: float, sample: Sequence[float], style: Style) -> None:
    """Draw the box of a group, centered at `y` mm."""
    line = {"color": style.color, "linewidth": 0.6}
    axes.boxplot(
        [sample],
        orientation="horizontal",
        positions=[y],
        widths=BOX_PART * BAR_MM,
        manage_ticks=False,
        showfliers=False,  # all runs are points
        patch_artist=True,
        boxprops={
            "facecolor": mixed(style.color, 0.3),
            "edgecolor": style.color,
            "linewidth": 0.6,
            "hatch": style.hatch,
        },
        medianprops={"color": style.color, "linewidth": 1.2},
        whiskerprops=line,
        capprops=line,
    )
    _draw_points(axes, y, sample, style)


def _draw_points(axes: Axes, y: float, sample: Sequence[float], style: Style) -> None:
    """Draw the runs of a group, with vertical offsets in their order."""
    offsets = np.linspace(-0.5, 0.5, len(sample)) * POINTS_PART * BAR_MM if len(sample) > 1 else np.zeros(1)
    axes.plot(sample, y + offsets, "o", color=style.color, markersize=2, mec="white", mew=0.3, zorder=3)
