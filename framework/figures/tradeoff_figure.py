"""A metric against the speed: one point per row, with the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from framework.errors import DataError
from framework.figures.figure_page import INK, MARGIN_MM, Page
from framework.figures.figure_runs import Pictured
from framework.figures.metric_axes import (
    LABEL_LEFT_MM,
    Legend,
    Names,
    check_metrics,
    draw_labels,
    page_width,
    style_axes,
    styles,
    values_of,
)
from framework.runs.stored_runs import Record
from framework.tables.metric_columns import Direction, described, direction, head

LEFT_MM, AXIS_MM = 11.0, 6.5  # width and height of the axis labels
PLOT_MM = 50.0  # minimum height of the diagram
NAMES_PART = 0.36  # maximum width of the names, relative to the width of the page

Point = tuple[float, float]


def tradeoff_figure(pictured: Pictured) -> Page:
    """Return a page with the means of two metrics for each group, and the Pareto front of the groups.

    Raises DataError if no run has both metrics.
    """
    x_key, y_key = pictured.choice.x_key, pictured.choice.shown_metric
    check_metrics(pictured, x_key, y_key)
    names: list[str] = []
    points: list[Point] = []
    colors: list[int] = []
    groups: list[list[Record]] = []
    for name, of_group in pictured.groups.items():
        for k, color in enumerate(pictured.colors):
            of_color = pictured.of_color(of_group, color)
            both = [one for one in of_color if values_of([one], x_key) and values_of([one], y_key)]
            if both:
                names.append(name)
                points.append((float(np.mean(values_of(both, x_key))), float(np.mean(values_of(both, y_key)))))
                colors.append(k)
                groups.append(both)
    if not points:
        raise DataError(f"figure: expected a run with {x_key} and {y_key}, got none; choose another metric")

    width = page_width(pictured)
    labels = Names(names, NAMES_PART * width)
    size = (
        width - LEFT_MM - labels.width - LABEL_LEFT_MM - 2 * MARGIN_MM,
        max(PLOT_MM, len(names) * max(labels.heights)),
    )
    legend = Legend(pictured.color_names, size[0])
    page = Page(width, AXIS_MM + size[1] + legend.height + 2 * MARGIN_MM, _note(pictured, groups))
    legend.draw(page, LEFT_MM, AXIS_MM + size[1] + legend.height + MARGIN_MM)
    axes = page.axes(LEFT_MM, AXIS_MM, *size)
    style_axes(axes, described(x_key), described(y_key), "y")
    all_styles = styles(len(pictured.colors))
    for point, k in zip(points, colors, strict=True):
        style = all_styles[k]
        axes.plot(*point, style.marker, color=style.color, markersize=3.6, mec="white", mew=0.4, zorder=3)
    axes.margins(0.08)
    front = pareto_front(points, (direction(x_key), direction(y_key)))
    if front:
        _draw_front(axes, [points[k] for k in front], (direction(x_key), direction(y_key)))
    draw_labels(axes, points, labels, [all_styles[k].color for k in colors], size)
    return page


def pareto_front(points: Sequence[Point], better: tuple[Direction, Direction]) -> list[int]:
    """Return the points that no other point dominates, in the order of x.

    A point dominates another one if it is at least as good in both metrics and better in one of them.

    Args:
        points: Values of the two metrics.
        better: Directions of better values.

    Returns:
        Indices of the points; empty if a metric has no direction.
    """
    if Direction.NONE in better:
        return []
    gains = np.array(points, np.float64).reshape(-1, 2) * better
    at_least = (gains[:, None] >= gains).all(axis=2)
    dominated = (at_least & (gains[:, None] > gains).any(axis=2)).any(axis=0)
    return sorted(np.flatnonzero(~dominated).tolist(), key=lambda k: points[k])


def _draw_front(axes: Axes, front: Sequence[Point], better: tuple[Direction, Direction]) -> None:
    """Draw the border of the region that the points of the front dominate, within the limits of the axes."""
    limits = axes.get_xlim(), axes.get_ylim()
    worst = [limit[0] if sign > 0 else limit[1] for limit, sign in zip(limits, better, strict=True)]
    ordered = sorted(front, key=lambda point: point[0] * better[0])
    corners: list[Point] = [(worst[0], ordered[0][1])]
    for (x, y), following in zip(ordered, [*ordered[1:], (ordered[-1][0], worst[1])], strict=True):
        corners += [(x, y), (x, following[1])]
    axes.plot(*zip(*corners, strict=True), color=INK, linewidth=0.6, dashes=(3, 2), zorder=2)
    axes.set(xlim=limits[0], ylim=limits[1])


def _note(pictured: Pictured, groups: Sequence[Sequence[object]]) -> str:
    x_key, y_key = pictured.choice.x_key, pictured.choice.shown_metric
    counts = sorted({len(records) for records in groups})
    runs = " to ".join(map(str, dict.fromkeys([counts[0], counts[-1]])))
    without = [head(key) for key in (x_key, y_key) if direction(key) is Direction.NONE]
    front = (
        f"No Pareto front: {' and '.join(without)} without a direction of better values."
        if without
        else "Dashed line: Pareto front; no other point is at least as good in both metrics and better in one of them."
    )
    return f"Points: means over the runs of each {pictured.unit} (n = {runs}). {front} {pictured.origin}"
