"""Parts of the diagrams of a metric: colors, axes, names, a legend and labels with leader lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.optimize import isotonic_regression

from framework.errors import DataError
from framework.figures.figure_page import (
    COLUMN_MM,
    FAINT_INK,
    HINTED,
    INCH_MM,
    INK,
    PAGE_MM,
    SMALL_PT,
    Page,
    text_width,
    wrapped,
)
from framework.figures.figure_runs import Pictured
from framework.runs.objective import OF_GROUND_TRUTH
from framework.runs.stored_runs import Record, is_number

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b6470")
"""Color-blind safe colors (Okabe and Ito, 2008) without yellow and black, which has too little or too much contrast."""

LINES = ("-", "--", ":", "-.")  # line styles; each is used with all colors
MARKERS = ("o", "s", "^", "D")  # marker styles; each is used with all colors
HATCHES = ("", "////", "....", "xxxx")  # fill patterns; each is used with all colors
TICKS = (1, 2, 2.5, 5, 10)  # distances of ticks, times a power of 10
LINE_MM = SMALL_PT / 72 * INCH_MM * 1.25  # line spacing of names
LEGEND_MM = 3.6  # line spacing of a legend
LABEL_LEFT_MM = 3.6  # distance from a diagram to the names next to it
PATCH_MM = (3.0, 1.8)  # width and height of a patch in a legend


@dataclass(frozen=True)
class Style:
    """Color and pattern of one group."""

    color: str
    line: str = LINES[0]
    marker: str = MARKERS[0]
    hatch: str = HATCHES[0]


def styles(count: int) -> list[Style]:
    """Return the styles of `count` groups. Groups with the same color differ in their pattern."""
    patterns = list(zip(LINES, MARKERS, HATCHES, strict=True))
    return [Style(COLORS[k % len(COLORS)], *patterns[k // len(COLORS) % len(patterns)]) for k in range(count)]


def page_width(pictured: Pictured, default: int = 1) -> float:
    """Return the width of a figure, mm; `default` is its width in columns of the page, unless the config sets it."""
    return COLUMN_MM if (pictured.choice.page_columns or default) == 1 else PAGE_MM


def values_of(records: Sequence[Record], key: str) -> list[float]:
    """Return the metric of each run; runs with an undefined value are omitted."""
    return [float(value) for record in records if is_number(value := record.metrics.get(key))]


def check_metrics(pictured: Pictured, *keys: str) -> None:
    """Raise DataError unless at least one run has a value of each metric."""
    known = {key for record in pictured.records for key, value in record.metrics.items() if is_number(value)}
    for key in keys:
        if key in known:
            continue
        close = get_close_matches(key, known, n=1)
        fix = f"did you mean {close[0]}?" if close else "choose a number in metrics.json of the runs"
        if key.startswith(OF_GROUND_TRUTH) and not any(one.startswith(OF_GROUND_TRUTH) for one in known):
            fix = "choose a dataset with ground truth or another metric"
        raise DataError(f"figure.metric: expected values of {key} in at least one run, got none; {fix}")


def style_axes(axes: Axes, x_label: str, y_label: str, grid: Literal["x", "y"]) -> None:
    """Label the axes, and draw thin ticks and the lines of a grid across the axis `grid`, x or y."""
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=TICKS))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=TICKS))
    axes.tick_params(labelsize=SMALL_PT, width=0.4, length=2, pad=2, color=FAINT_INK, labelcolor=INK)
    axes.grid(axis=grid, color="#e6e8eb", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(x_label, fontsize=SMALL_PT, labelpad=1.5, color=INK)
    axes.set_ylabel(y_label, fontsize=SMALL_PT, labelpad=1.5, color=INK)


class Names:
    """Names of rows as wrapped lines."""

    def __init__(self, names: Sequence[str], widest: float) -> None:
        """Wrap the names to at most `widest` mm."""
        self.texts = ["\n".join(wrapped(name, widest / HINTED, SMALL_PT)) for name in names]
        lines = [line for text in self.texts for line in text.splitlines()]
        self.width = max((text_width(line, SMALL_PT) * HINTED for line in lines), default=0.0)  # mm
        self.heights = [LINE_MM * max(1, len(text.splitlines())) for text in self.texts]  # mm


class Legend:
    """A legend of several styles, in lines of a given width."""

    def __init__(self, names: Sequence[str], width: float) -> None:
        self._names, self._styles, self._width = names, styles(len(names)), width
        self._lines: list[list[tuple[float, int]]] = []  # left edge, mm, and index of each entry
        left = 0.0
        for k, name in enumerate(names if len(names) > 1 else []):
            entry = PATCH_MM[0] + 1 + text_width(name, SMALL_PT) * HINTED + 3
            if not self._lines or left + entry > width:
                self._lines.append([])
                left = 0.0
            self._lines[-1].append((left, k))
            left += entry

    @property
    def height(self) -> float:
        """Height, mm; 0 for a single style."""
        return LEGEND_MM * len(self._lines) + (1.0 if self._lines else 0.0)

    def draw(self, page: Page, left: float, top: float) -> None:
        """Draw the legend with its upper left corner at (left, top), mm."""
        for number, line in enumerate(self._lines):
            middle = top - LEGEND_MM * (number + 0.5)
            for offset, k in line:
                patch = page.axes(left + offset, middle - PATCH_MM[1] / 2, *PATCH_MM)
                patch.set_axis_off()
                patch.add_patch(bar((0, 0), 1, 1, self._styles[k], 0.8))
                start, name = left + offset + PATCH_MM[0] + 1, self._names[k]
                fitting = min(1.0, (self._width - PATCH_MM[0] - 1) / (text_width(name, SMALL_PT) * HINTED))
                page.text(start, middle, name, va="center", fontsize=SMALL_PT * fitting, color=INK)


def bar(corner: tuple[float, float], width: float, height: float, style: Style, strength: float) -> Rectangle:
    """Return a filled rectangle; `strength` in [0, 1] is the fraction of the color in a mix with white."""
    return Rectangle(
        corner, width, height, fc=mixed(style.color, strength), ec=style.color, hatch=style.hatch, linewidth=0.5
    )


def mixed(color: str, strength: float) -> tuple[float, float, float]:
    """Return a mix of a color #rrggbb with white as red, green and blue in [0, 1]."""
    red, green, blue = (1 - strength * (1 - int(color[k : k + 2], 16) / 255) for k in (1, 3, 5))
    return red, green, blue


def spread(positions: Sequence[float], gap: float, low: float = -np.inf, high: float = np.inf) -> list[float]:
    """Return positions in the same order, at least `gap` apart, with the smallest sum of squared displacements.

    The positions are in [low, high], which must be long enough.
    """
    order = np.argsort(positions, kind="stable")
    steps = gap * np.arange(len(order))
    result = np.empty(len(order))
    free = isotonic_regression(np.asarray(positions)[order] - steps).x if len(order) else steps
    result[order] = np.clip(free, low, high - gap * max(0, len(order) - 1)) + steps
    return result.tolist()


def draw_labels(
    axes: Axes, targets: Sequence[tuple[float, float]], names: Names, colors: Sequence[str], size: tuple[float, float]
) -> None:
    """Write names to the right of a diagram, with leader lines to their points.

    Args:
        axes: The diagram with all its data. Its limits are fixed.
        targets: Points of the names, in data coordinates.
        names: The names.
        colors: Colors of the names.
        size: Width and height of the diagram, mm.
    """
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())  # the leader lines do not change the limits
    places = axes.transAxes.inverted().transform(axes.transData.transform(np.array(targets).reshape(-1, 2)))
    gap = max(names.heights, default=0.0) / size[1]
    ends = spread(places[:, 1].tolist(), gap, gap / 2, max(1.0, gap * len(targets)) - gap / 2)
    for (x, y), end, text, color in zip(places, ends, names.texts, colors, strict=True):
        line = [x, 1 + 1 / size[0], 1 + 3 / size[0]], [y, end, end]
        axes.plot(*line, color=color, linewidth=0.4, alpha=0.6, transform=axes.transAxes, clip_on=False, zorder=1)
        style: dict[str, Any] = {"va": "center", "fontsize": SMALL_PT, "linespacing": 1.05, "color": color}
        axes.text(1 + LABEL_LEFT_MM / size[0], end, text, transform=axes.transAxes, **style)
