"""Stacked bars of the contributions of the stages to the loss, one bar per run."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes

from framework.explanation.contributions import REST, Contributions
from framework.figures.figure_page import COLUMN_MM, FAINT_INK, MARGIN_MM, PAGE_MM, SMALL_PT, Page, text_width
from framework.figures.metric_axes import Names, style_axes

COLORS = {
    "detection": "#0072b2",
    "tracking": "#009e73",
    "refinement": "#d55e00",
    "association": "#c2609a",
    REST: "#9aa5b1",
}
"""Color by the name of the contribution, as in the reports."""

BAR_MM, GAP_MM = 3.4, 2.0  # height of a bar, and space between bars
AXIS_MM, LEGEND_MM = 6.5, 4.0  # height of the axis labels and of the legend
NAMES_PART = 0.38  # maximum width of the names, relative to the width of the page


def contribution_figure(of_runs: Mapping[str, Contributions]) -> Page:
    """Return a page with one bar per run; with several runs, the last bar is their mean."""
    rows = dict(of_runs)
    if len(of_runs) > 1:
        rows["mean"] = Contributions.mean(list(of_runs.values()))
    metric = next(iter(rows.values())).metric
    width = COLUMN_MM if len(rows) == 1 else PAGE_MM
    names = Names(list(rows), NAMES_PART * width)
    left = MARGIN_MM + names.width + 1.5
    heights = [max(name, BAR_MM) + GAP_MM for name in names.heights]
    note = (
        "Shapley values of the stages: mean decrease of the loss when the ground truth replaces a stage. "
        f"{REST.capitalize()}: loss with all stages replaced. Negative values are left of 0."
    )
    page = Page(width, AXIS_MM + sum(heights) + LEGEND_MM + MARGIN_MM, note)
    axes = page.axes(left, AXIS_MM, width - left - 3 * MARGIN_MM, sum(heights))
    centers: list[float] = []
    top = sum(heights)
    for height in heights:
        top -= height
        centers.append(top + height / 2)
    axes.set_ylim(0, sum(heights))
    draw_bars(axes, rows, centers, BAR_MM)
    style_axes(axes, f"loss (1 - {metric})", "", "x")
    axes.set_yticks(centers, list(rows))
    axes.tick_params(axis="y", length=0)
    x = left
    for name, color in COLORS.items():
        page.text(x, AXIS_MM + sum(heights) + 1, "■", fontsize=SMALL_PT, color=color)
        page.text(x + 2.5, AXIS_MM + sum(heights) + 1, name, fontsize=SMALL_PT, color=FAINT_INK)
        x += text_width(name, SMALL_PT) + 5
    return page


def draw_bars(axes: Axes, rows: Mapping[str, Contributions], centers: list[float], height: float) -> None:
    """Draw one stacked bar per row; negative contributions are stacked to the left of 0."""
    for center, contributions in zip(centers, rows.values(), strict=True):
        ends = {True: 0.0, False: 0.0}  # right and left end of the bar
        for name, value in contributions.named().items():
            axes.barh(center, value, height, left=ends[value >= 0], color=COLORS[name], gid=f"contribution-{name[:4]}")
            ends[value >= 0] += value
    axes.axvline(0, color=FAINT_INK, linewidth=0.5)
