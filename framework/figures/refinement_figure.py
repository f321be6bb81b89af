"""The clusters of one frame before and after refinement, in the image and from the side: the paper's Figure 5."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from framework.data import Int32, UInt8
from framework.evaluation.refined_points import Refinement, point_counts
from framework.figures.cluster_image import image_panel
from framework.figures.cluster_marks import ClusterMarks, name_of
from framework.figures.drawing import (
    GAP,
    MARGIN,
    PANEL_WIDTH,
    TAG_PX,
    TEXT_PX,
    TITLE_PX,
    WIDTH,
    font_of,
    rgb_of,
    shortened,
)
from framework.figures.side_view import SideView, side_panel
from framework.files.atomic_write import written_whole
from framework.rendering.palette import FAINT_INK, INK, PAPER

TITLE_HEIGHT, FIGURES_HEIGHT, ROW_HEIGHT = 52, 46, 30  # px
TABLE_COLUMNS, TABLE_ROWS_MAX = 3, 8
BETTER, WORSE = (24, 128, 72), (190, 40, 40)


def write_refinement(path: Path, refinement: Refinement, title: str, refiner: str) -> None:
    """Draws `refinement_picture` to a PNG."""
    image = refinement_picture(refinement, title, refiner)
    with written_whole(path) as temporary:
        Image.fromarray(image).save(temporary)


def refinement_picture(refinement: Refinement, title: str, refiner: str) -> UInt8:
    """The picture (H, WIDTH, 3) RGB.

    Args:
        title: what the frame is, and whose clusters these are.
        refiner: how the refiner is called.
    """
    columns = ClusterMarks.before(refinement), ClusterMarks.after(refinement)
    frame = refinement.frame
    side = SideView.of(frame, *columns)
    rows = [
        _title(title, refiner),
        _beside([image_panel(frame, column) for column in columns]),
        _blank(GAP),
        _beside([side_panel(frame, column, side) for column in columns]),
        _figures(refinement),
        _table(refinement, columns[0]),
        _blank(MARGIN // 2),
    ]
    return np.concatenate(rows)


def _figures(refinement: Refinement) -> UInt8:
    """The line below the panels."""
    n, m = len(refinement.before), len(refinement.after)
    before, after = int(refinement.points_before.sum()), int(point_counts(refinement.after).sum())
    was, now = refinement.fit_before, refinement.fit_after
    parts = ["nothing was detected"]
    if n:
        parts = ["1 cluster" if n == m == 1 else f"{n} clusters" if n == m else f"{n} → {m} clusters"]
        parts.append(f"{before:,} → {after:,} points{_change(before, after)}")
    judged = refinement.judged_before, refinement.judged_after
    if was is not None and now is not None and judged[0].any() and judged[1].any():
        iou = was.iou[judged[0]].mean(), now.iou[judged[1]].mean()
        parts.append(f"mean IoU with the true masks {iou[0]:.2f} → {iou[1]:.2f}")
        inside = (
            _share(was.points_inside[judged[0]], refinement.points_before[judged[0]]),
            _share(now.points_inside[judged[1]], point_counts(refinement.after)[judged[1]]),
        )
        parts.append(f"points on the true object {inside[0]} → {inside[1]}")
    parts.append(f"{refinement.milliseconds:.1f} ms")
    image = Image.new("RGB", (WIDTH, FIGURES_HEIGHT), PAPER)
    text = "   ·   ".join(parts)
    ImageDraw.Draw(image).text((MARGIN, FIGURES_HEIGHT / 2), text, INK, font_of(TEXT_PX, bold=True), anchor="lm")
    return np.asarray(image)


def _share(points: Int32, of: Int32) -> str:
    return f"{100 * points.sum() / of.sum():.0f} %" if of.any() else "none"


def _change(before: int, after: int) -> str:
    """By how much a number of points has changed, in brackets."""
    if before == 0:
        return ""
    change = round(100 * (after - before) / before)
    sign = "+" if change > 0 else "−" if change < 0 else "±"
    return f" ({sign}{abs(change)} %)"


def _table(refinement: Refinement, column: ClusterMarks) -> UInt8:
    """What happened to each cluster, in the order of the detections."""
    n, places = len(refinement.before), TABLE_COLUMNS * TABLE_ROWS_MAX
    shown = n if n <= places else places - 1
    rows = -(-min(n, places) // TABLE_COLUMNS)
    image = Image.new("RGB", (WIDTH, ROW_HEIGHT * (rows + 1 if rows else 0)), PAPER)
    canvas, font, small = ImageDraw.Draw(image), font_of(TEXT_PX), font_of(TAG_PX)
    step = (WIDTH - 2 * MARGIN) / TABLE_COLUMNS
    name_at, points_at, iou_at = 24, 184, step - 24  # px in a column; the last one is where it ends
    was, now = refinement.fit_before, refinement.fit_after
    for k in range(shown):
        x, y = MARGIN + step * (k // rows), ROW_HEIGHT * (k % rows + 1.5)
        if k % rows == 0:
            canvas.text((x + points_at, ROW_HEIGHT / 2), "points", FAINT_INK, small, anchor="lm")
            if was is not None:
                canvas.text((x + iou_at, ROW_HEIGHT / 2), "IoU with the true mask", FAINT_INK, small, anchor="rm")
        canvas.rounded_rectangle((x, y - 8, x + 16, y + 8), 4, fill=rgb_of(column.colors[k]))
        name = shortened(name_of(column.clusters, k), canvas, font, points_at - name_at - 8)
        canvas.text((x + name_at, y), name, INK, font, anchor="lm")
        before, after = int(refinement.points_before[k]), int(refinement.points_after[k])
        parts = np.count_nonzero(refinement.origin == k)
        split = f" in {parts}" if parts > 1 else ""
        text = f"{before:,} → {after:,}{split}{_change(before, after)}"
        canvas.text((x + points_at, y), text, FAINT_INK, small, anchor="lm")
        if was is not None and now is not None:
            text, ink = "not known", FAINT_INK
            if refinement.judged_before[k]:
                part = refinement.main_part[k]
                iou = round(float(was.iou[k]), 2), round(float(now.iou[part]), 2) if part >= 0 else 0.0
                text = f"{iou[0]:.2f} → {iou[1]:.2f}"
                ink = INK if iou[0] == iou[1] else BETTER if iou[1] > iou[0] else WORSE
            canvas.text((x + iou_at, y), text, ink, font if ink != FAINT_INK else small, anchor="rm")
    if shown < n:
        x, y = MARGIN + step * (TABLE_COLUMNS - 1), ROW_HEIGHT * (rows + 0.5)
        canvas.text((x, y), f"and {n - shown} more", FAINT_INK, font, anchor="lm")
    return np.asarray(image)


def _title(text: str, refiner: str) -> UInt8:
    image = Image.new("RGB", (WIDTH, TITLE_HEIGHT), PAPER)
    canvas, font, bold = ImageDraw.Draw(image), font_of(TITLE_PX), font_of(TITLE_PX, bold=True)
    refiner = shortened(refiner, canvas, bold, PANEL_WIDTH)
    text = shortened(text, canvas, font, WIDTH - 2 * MARGIN - GAP - canvas.textlength(refiner, bold))
    canvas.text((MARGIN, TITLE_HEIGHT / 2), text, INK, font, anchor="lm")
    canvas.text((WIDTH - MARGIN, TITLE_HEIGHT / 2), refiner, INK, bold, anchor="rm")
    return np.asarray(image)


def _beside(panels: Sequence[UInt8]) -> UInt8:
    height = panels[0].shape[0]
    row = np.tile(np.array(PAPER, np.uint8), (height, WIDTH, 1))
    for k, panel in enumerate(panels):
        left = MARGIN + k * (PANEL_WIDTH + GAP)
        row[:, left : left + PANEL_WIDTH] = panel
    return row


def _blank(height: int) -> UInt8:
    return np.tile(np.array(PAPER, np.uint8), (height, WIDTH, 1))
