"""A frame's clusters over its colour image: tinted, outlined and named."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from PIL import Image, ImageDraw

from framework.data import Array, Bool, Float32, Frame, UInt8
from framework.figures.cluster_marks import ClusterMarks, name_of
from framework.figures.drawing import (
    DROPPED,
    PANEL_WIDTH,
    SUPERSAMPLING,
    TAG_PX,
    downsampled,
    draw_heading,
    font_of,
    rgb_of,
)
from framework.rendering.palette import INK, PAPER

HEIGHT_MAX = 660  # px
STRIPE_PX = 5  # of the hatching
LEAST_OUTLINE_PX = 12  # of the image, length around a piece or a hole that is outlined
TAG_ROOM = 4.0  # a cluster that shows less, in areas of its tag, would be hidden by it
WHITE, SOME_COLOR = (255, 255, 255), (150, 150, 150)

Box = tuple[float, float, float, float]  # left, top, right, bottom, px


def image_panel(frame: Frame, column: ClusterMarks) -> UInt8:
    """(H, PANEL_WIDTH, 3) RGB."""
    height, width = frame.depth.shape
    scale = min(PANEL_WIDTH / width, HEIGHT_MAX / height)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    fine = size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING
    enlarges = fine[0] > height
    color = cv2.resize(frame.color, fine[::-1], interpolation=cv2.INTER_CUBIC if enlarges else cv2.INTER_AREA)
    gray = color.mean(axis=2, keepdims=True, dtype=np.float32)
    drawn = 0.55 * color + 0.28 * gray + 38.0  # pale, so that the clusters stand out

    masks = {k: _enlarged(_filled(column.mask(k), frame.depth), fine) for k in column.by_size()}
    for k, mask in masks.items():
        drawn[mask] = (0.42 * gray[mask] + 0.30 * color[mask]) * 0.72 + 0.5 * column.colors[k]
    drawn = np.clip(drawn, 0, 255)
    _hatch(drawn, _enlarged(column.added, fine), WHITE, 0.75, falling=True)
    _hatch(drawn, _enlarged(column.dropped, fine), DROPPED, 0.9, falling=False)
    canvas = drawn.astype(np.uint8)
    borders = {k: _border(mask, LEAST_OUTLINE_PX * fine[0] / height) for k, mask in masks.items()}
    for border in borders.values():
        cv2.polylines(canvas, border, True, WHITE, 3 * SUPERSAMPLING, cv2.LINE_AA)
    for k, border in borders.items():
        cv2.polylines(canvas, border, True, rgb_of(0.62 * column.colors[k]), round(1.6 * SUPERSAMPLING), cv2.LINE_AA)
    picture = Image.fromarray(downsampled(canvas, size))
    panel = Image.new("RGB", (PANEL_WIDTH, size[0]), PAPER)
    left = (PANEL_WIDTH - size[1]) // 2
    _tag_clusters(picture, column)
    panel.paste(picture, (left, 0))
    draw_heading(panel, column.heading, left)
    _key(panel, column, left)
    return np.asarray(panel)


def _filled(mask: Bool, depth: Float32) -> Bool:
    """A cluster has no pixels without a reading: single ones are filled, so that its outline is one line."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
    return np.asarray(mask | (closed & (depth == 0)))


def _enlarged(mask: Bool, shape: tuple[int, int]) -> Bool:
    """A mask (h, w) at another size, its border smooth."""
    return np.asarray(cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5)


def _border(mask: Bool, least: float) -> list[Array]:
    """The closed lines around a mask and its holes, those of at least that length, px."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [line for line in lines if len(line) >= least]


def _hatch(drawn: Float32, mask: Bool, color: tuple[int, int, int], strength: float, falling: bool) -> None:
    """Draws oblique stripes on (H, W, 3) where the mask is."""
    v, u = np.nonzero(mask)
    stripe = (u - v if falling else u + v) // (STRIPE_PX * SUPERSAMPLING) % 2 == 0
    u, v = u[stripe], v[stripe]
    drawn[v, u] = (1 - strength) * drawn[v, u] + strength * np.array(color, np.float32)


def _tag_clusters(picture: Image.Image, column: ClusterMarks) -> None:
    """Names each cluster where it shows, the large ones first.

    A tag moves aside for those already there, and is left out where there is no room; that of a small cluster stands
    above it.
    """
    canvas, font = ImageDraw.Draw(picture), font_of(TAG_PX)
    scale = picture.width / column.owner.shape[1]
    taken = [(0.0, 0.0, 110.0, 40.0), (0.0, picture.height - 40.0, 230.0, float(picture.height))]  # heading and key
    for k in column.by_size():
        v, u = np.nonzero(column.owner == k)
        if len(u) == 0:
            continue
        name = name_of(column.clusters, k)
        size = canvas.textlength(name, font) + 12, TAG_PX + 7.0
        middle = np.hypot(u - u.mean(), v - v.mean()).argmin()
        at = u[middle] * scale, v[middle] * scale
        if len(u) * scale**2 < TAG_ROOM * size[0] * size[1]:
            at = u.mean() * scale, v.min() * scale - size[1] / 2 - 5
        box = _free_place(at, size, picture.size, taken)
        if box is None:
            continue
        taken.append(box)
        rgb = column.colors[k].astype(float)
        canvas.rounded_rectangle(box, 4, fill=rgb_of(0.35 * rgb + 0.65 * 255), outline=rgb_of(0.62 * rgb))
        canvas.text(((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), name, INK, font, anchor="mm")


def _free_place(
    middle: tuple[float, float],
    size: tuple[float, float],
    room: tuple[int, int],
    taken: Sequence[Box],
) -> Box | None:
    """The box nearest to `middle` that overlaps no other one; None where there is none near."""
    steps = [(dx, dy) for dy in range(-4, 5) for dx in range(-3, 4)]
    for dx, dy in sorted(steps, key=lambda step: (abs(step[0]) * size[0] / 2 + abs(step[1]) * size[1], step)):
        x = min(max(middle[0] + dx * size[0] / 2, size[0] / 2 + 2), room[0] - size[0] / 2 - 2)
        y = min(max(middle[1] + dy * (size[1] + 3), size[1] / 2 + 2), room[1] - size[1] / 2 - 2)
        box = (x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2)
        if not any(box[0] < b[2] + 2 and b[0] < box[2] + 2 and box[1] < b[3] + 2 and b[1] < box[3] + 2 for b in taken):
            return box
    return None


def _key(panel: Image.Image, column: ClusterMarks, left: int) -> None:
    """What the hatchings mean, in the lower left corner; only those that there are."""
    shown = [("dropped", PAPER, DROPPED, False)] if column.dropped.any() else []
    shown += [("added", SOME_COLOR, WHITE, True)] if column.added.any() else []
    if not shown:
        return
    canvas, font = ImageDraw.Draw(panel), font_of(TAG_PX)
    widths = [canvas.textlength(text, font) + 44 for text, *_ in shown]
    bottom = panel.height - 8
    canvas.rounded_rectangle((left + 8, bottom - 28, left + 8 + sum(widths) + 6, bottom), 4, fill=PAPER)
    x = left + 18.0
    for (text, ground, color, falling), width in zip(shown, widths, strict=True):
        swatch = np.tile(np.array(ground, np.float32), (16 * SUPERSAMPLING, 22 * SUPERSAMPLING, 1))
        _hatch(swatch, np.ones(swatch.shape[:2], np.bool_), color, 1.0, falling)
        panel.paste(Image.fromarray(downsampled(swatch, (16, 22))), (round(x), bottom - 22))
        canvas.text((x + 28, bottom - 14), text, INK, font, anchor="lm")
        x += width
