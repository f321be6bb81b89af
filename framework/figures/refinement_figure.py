"""Clusters of one frame before and after refinement, in the image and from the side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from framework.data import Array, Frame, Int32, UInt8
from framework.evaluation.refined_points import Refinement, point_counts
from framework.figures.cluster_marks import DROPPED, ClusterMarks
from framework.figures.figure_page import FAINT_INK, INCH_MM, INK, draw_names
from framework.figures.side_view import SideView, draw_side
from framework.files.atomic_write import atomic_write
from framework.rendering.palette import PAPER

DPI = 100
WIDTH_IN, MARGIN_IN, GAP_IN, HEAD_IN = 16.4, 0.2, 0.16, 0.35  # HEAD_IN above each panel
PANEL_IN = (WIDTH_IN - 2 * MARGIN_IN - GAP_IN) / 2  # width of a panel
MAX_IMAGE_IN, SIDE_IN, TITLE_IN, ROW_IN = 6.6, 4.6, 0.4, 0.3  # heights of image, side view, title and table row
TITLE_PT, TEXT_PT, SMALL_PT = 15.0, 12.0, 10.5
MAX_TITLE, MAX_REFINER, MAX_NAME = 90, 45, 18  # maximum numbers of characters
TABLE_COLUMNS, MAX_ROWS = 3, 8
NAME_AT, POINTS_AT = 0.016, 0.12  # positions in a column, as fractions of the width of the table
BETTER, WORSE = "#188048", "#be2828"  # text colors of increased and decreased IoU


def write_refinement(path: Path, refinement: Refinement, title: str, refiner: str) -> None:
    """Write `refinement_figure` as a PNG."""
    with atomic_write(path) as temporary:
        refinement_figure(refinement, title, refiner).savefig(temporary)


def refinement_figure(refinement: Refinement, title: str, refiner: str) -> Figure:
    """Return a figure of the clusters of one frame before and after refinement.

    Args:
        refinement: Clusters before and after refinement.
        title: Title with the frame and the detector.
        refiner: Name of the refiner.
    """
    frame = refinement.frame
    columns = ClusterMarks.before(refinement), ClusterMarks.after(refinement)
    height, width = frame.depth.shape
    image_in = min(MAX_IMAGE_IN, PANEL_IN * height / width)
    image_width_in = image_in * width / height
    rows = -(-min(len(refinement.before), TABLE_COLUMNS * MAX_ROWS) // TABLE_COLUMNS)
    table_in = ROW_IN * (rows + 2)
    total_in = TITLE_IN + HEAD_IN + image_in + HEAD_IN + SIDE_IN + table_in + MARGIN_IN
    side = SideView.of(frame, *columns, PANEL_IN / SIDE_IN)
    with rc_context({"text.parse_math": False, "hatch.linewidth": 2.2}):
        figure = Figure((WIDTH_IN, total_in), dpi=DPI, facecolor=np.array(PAPER) / 255)

        def axes_at(left: float, bottom: float, width: float, height: float) -> Axes:
            return figure.add_axes((left / WIDTH_IN, bottom / total_in, width / WIDTH_IN, height / total_in))

        titles = axes_at(MARGIN_IN, total_in - TITLE_IN, WIDTH_IN - 2 * MARGIN_IN, TITLE_IN)
        titles.axis("off")
        titles.text(0, 0.4, _shortened(title, MAX_TITLE), fontsize=TITLE_PT, color=INK, va="center")
        name = _shortened(refiner, MAX_REFINER)
        titles.text(1, 0.4, name, fontsize=TITLE_PT, color=INK, weight="bold", ha="right", va="center")
        for k, marks in enumerate(columns):
            left = MARGIN_IN + k * (PANEL_IN + GAP_IN)
            bottom = table_in + MARGIN_IN + SIDE_IN + HEAD_IN
            axes = axes_at(left + (PANEL_IN - image_width_in) / 2, bottom, image_width_in, image_in)
            draw_image(axes, frame, marks, image_width_in)
            side_axes = axes_at(left, table_in + MARGIN_IN, PANEL_IN, SIDE_IN)
            draw_side(side_axes, frame, marks, side, SIDE_IN)
            for panel, heading in ((axes, marks.heading), (side_axes, f"{marks.heading}, side view")):
                panel.set_title(heading, loc="left", fontsize=TEXT_PT, weight="bold", color=INK)
        table = axes_at(MARGIN_IN, MARGIN_IN / 2, WIDTH_IN - 2 * MARGIN_IN, table_in)
        table.set(ylim=(rows + 2, 0), xlim=(0, 1))
        table.axis("off")
        table.text(0, 0.5, _summary(refinement), fontsize=TEXT_PT, weight="bold", color=INK, va="center")
        _draw_table(table, refinement, columns[0], rows)
    return figure


def draw_image(axes: Axes, frame: Frame, marks: ClusterMarks, width_in: float) -> None:
    """Draw the image with tinted, outlined and named clusters. Dropped and added pixels are hatched."""
    axes.imshow(tinted(frame, marks), interpolation="antialiased", aspect="auto")
    axes.axis("off")
    for k in marks.by_size():
        cluster = marks.mask(k).astype(np.uint8)
        closed = cv2.morphologyEx(cluster, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        smooth = cv2.medianBlur(np.where(frame.depth == 0, closed, cluster), 5)  # fills holes at missing depth
        if smooth.any():
            outline = axes.contour(*_region(smooth), [0.5], colors=[0.62 * marks.colors[k] / 255], linewidths=1.2)
            outline.set(path_effects=[withStroke(linewidth=2.2, foreground="white")])
    legend = []
    for name, mask, hatch, color in (
        ("dropped", marks.dropped, "////", np.array(DROPPED) / 255),
        ("added", marks.added, "\\\\\\\\", np.ones(3)),
    ):
        if mask.any():
            area = axes.contourf(*_region(mask), [0.5, 1.5], colors="none", hatches=[hatch])
            area.set(edgecolor=color, linewidth=0)
            legend.append(Patch(facecolor="0.6", edgecolor=color, hatch=hatch, linewidth=0, label=name))
    height, width = frame.depth.shape
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    if legend:
        place = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.2}
        axes.legend(handles=legend, ncols=2, frameon=False, fontsize=SMALL_PT, **place)
    names = {k + 1: marks.name(k) for k in marks.by_size()}
    draw_names(axes, marks.owner + 1, names, SMALL_PT, width_in * INCH_MM)


def tinted(frame: Frame, marks: ClusterMarks) -> UInt8:
    """Return the RGB image (H, W, 3), desaturated, with the clusters in their colors."""
    gray = frame.color.mean(axis=2, keepdims=True)
    image = 0.55 * frame.color + 0.28 * gray + 38.0
    for k in marks.by_size():
        mask = marks.mask(k)
        image[mask] = (0.42 * gray[mask] + 0.30 * frame.color[mask]) * 0.72 + 0.5 * marks.colors[k]
    return np.asarray(np.clip(image, 0, 255), np.uint8)


def _region(mask: Array) -> tuple[Array, Array, Array]:
    """Return the x coordinates, y coordinates and values of a mask (H, W), padded with 0 to close its contours."""
    height, width = mask.shape
    return np.arange(-1, width + 1), np.arange(-1, height + 1), np.pad(mask.astype(float), 1)


def _summary(refinement: Refinement) -> str:
    n, m = len(refinement.before), len(refinement.after)
    before, after = int(refinement.points_before.sum()), int(point_counts(refinement.after).sum())
    was, now = refinement.fit_before, refinement.fit_after
    parts = ["no detections"]
    if n:
        parts = ["1 cluster" if n == m == 1 else f"{n} clusters" if n == m else f"{n} → {m} clusters"]
        parts.append(f"{before:,} → {after:,} points{_change(before, after)}")
    judged = refinement.judged_before, refinement.judged_after
    if was is not None and now is not None and judged[0].any() and judged[1].any():
        iou = was.iou[judged[0]].mean(), now.iou[judged[1]].mean()
        parts.append(f"mean IoU with the ground-truth masks {iou[0]:.2f} → {iou[1]:.2f}")
        inside = (
            _percentage(was.points_inside[judged[0]], refinement.points_before[judged[0]]),
            _percentage(now.points_inside[judged[1]], point_counts(refinement.after)[judged[1]]),
        )
        parts.append(f"points on the ground-truth object {inside[0]} → {inside[1]}")
    return "   ·   ".join([*parts, f"{refinement.milliseconds:.1f} ms"])


def _draw_table(axes: Axes, refinement: Refinement, marks: ClusterMarks, rows: int) -> None:
    """Draw a table with the change of each cluster, in the order of the detections. A row is one unit of y high."""
    n, places = len(refinement.before), TABLE_COLUMNS * MAX_ROWS
    shown = n if n <= places else places - 1
    was, now = refinement.fit_before, refinement.fit_after

    def write(x: float, y: float, text: str, color: str = FAINT_INK, size: float = SMALL_PT, ha: str = "left") -> None:
        axes.text(x, y, text, fontsize=size, color=color, ha=ha, va="center")

    for k in range(shown):
        left, y = k // rows / TABLE_COLUMNS, k % rows + 2.5
        right = left + 0.95 / TABLE_COLUMNS
        if k % rows == 0:
            write(left + POINTS_AT, 1.5, "points")
            if was is not None:
                write(right, 1.5, "IoU with ground truth", ha="right")
        axes.plot(left + 0.005, y, "s", markersize=10, color=marks.colors[k] / 255, clip_on=False)
        write(left + NAME_AT, y, _shortened(marks.name(k), MAX_NAME), INK, TEXT_PT)
        before, after = int(refinement.points_before[k]), int(refinement.points_after[k])
        parts = np.count_nonzero(refinement.origin == k)
        split = f" in {parts}" if parts > 1 else ""
        write(left + POINTS_AT, y, f"{before:,} → {after:,}{split}{_change(before, after)}")
        if was is not None and now is not None:
            if not refinement.judged_before[k]:
                write(right, y, "unknown", ha="right")
                continue
            part = refinement.main_part[k]
            iou = round(float(was.iou[k]), 2), round(float(now.iou[part]), 2) if part >= 0 else 0.0
            color = INK if iou[0] == iou[1] else BETTER if iou[1] > iou[0] else WORSE
            write(right, y, f"{iou[0]:.2f} → {iou[1]:.2f}", color, TEXT_PT, "right")
    if shown < n:
        write((TABLE_COLUMNS - 1) / TABLE_COLUMNS, rows + 1.5, f"and {n - shown} more", size=TEXT_PT)


def _percentage(points: Int32, of: Int32) -> str:
    return f"{100 * points.sum() / of.sum():.0f}%" if of.any() else "none"


def _change(before: int, after: int) -> str:
    """Return the relative change of a number of points, in parentheses."""
    if before == 0:
        return ""
    change = round(100 * (after - before) / before)
    sign = "+" if change > 0 else "−" if change < 0 else "±"
    return f" ({sign}{abs(change)}%)"


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"
