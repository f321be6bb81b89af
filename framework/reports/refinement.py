"""The clusters of one frame before and after refinement, in the image and from the side: the paper's Figure 5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from framework.atomic_files import written_whole
from framework.data import Array, Bool, Float32, Float64, Frame, Int32, PointClusters, UInt8
from framework.evaluation.refinement import Refinement, pixel_index, point_counts
from framework.geometry import back_project
from framework.reports.overview import FAINT_INK, INK, NOTHING, PAPER
from framework.reports.palette import instance_colors
from framework.reports.point_cloud import orthographic, shading, splat
from framework.reports.surface import Surface
from framework.reports.viewpoint import looking, upward

WIDTH, MARGIN, GAP = 1640, 20, 16  # px
PANEL_WIDTH = (WIDTH - 2 * MARGIN - GAP) // 2
IMAGE_HEIGHT_MAX, SIDE_HEIGHT = 660, 460  # px
SUPERSAMPLING = 2  # pixels that are drawn for one, in either direction
TITLE_HEIGHT, FIGURES_HEIGHT, ROW_HEIGHT = 52, 46, 30  # px
TABLE_COLUMNS, TABLE_ROWS_MAX = 3, 8
TITLE_PX, TEXT_PX, TAG_PX = 22, 17, 15

AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(75), np.deg2rad(14)  # of the view from the side; 90 would be exactly from it
SIDE_MARGIN = 0.09  # share of the picture around the clusters
LEAST_EXTENT_M = 0.4  # a single point is not enlarged without end
LEVEL_STEP_PX = 4  # of the coarse surface in which the floor is looked for
DROPPED = (214, 28, 44)
WHITE, SOME_COLOR = (255, 255, 255), (150, 150, 150)
STRIPE_PX = 5  # of the hatching
LEAST_OUTLINE_PX = 12  # of the image, length around a piece or a hole that is outlined
BETTER, WORSE = (24, 128, 72), (190, 40, 40)
SCALE_BARS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def write_refinement(path: Path, refinement: Refinement, title: str, refiner: str) -> None:
    """Draws `refinement_picture` to a PNG."""
    image = refinement_picture(refinement, title, refiner)
    with written_whole(path) as temporary:
        Image.fromarray(image).save(temporary, optimize=True)


def refinement_picture(refinement: Refinement, title: str, refiner: str) -> UInt8:
    """The picture (H, WIDTH, 3) RGB.

    Args:
        title: the line above, what the frame is.
        refiner: how the refiner is called, for the line of figures.
    """
    columns = _Column.before(refinement), _Column.after(refinement)
    frame = refinement.frame
    side = _Side.of(frame, columns[0], columns[1])
    rows = [
        _title(title),
        _beside([_image_panel(frame, column) for column in columns]),
        _blank(GAP),
        _beside([_side_panel(frame, column, side) for column in columns]),
        _figures(refinement, refiner),
        _table(refinement, columns[0]),
        _blank(MARGIN // 2),
    ]
    return np.concatenate(rows)


@dataclass(frozen=True)
class _Column:
    """The clusters of one column of the picture, and how they are marked."""

    heading: str
    clusters: PointClusters
    colors: UInt8  # (K, 3)
    owner: Int32  # (H, W) the cluster that shows: of several over a pixel the smallest; -1 = none
    dropped: Bool  # (H, W) in some cluster before, in none now
    added: Bool  # (H, W) new in the cluster that shows

    @classmethod
    def before(cls, refinement: Refinement) -> _Column:
        clusters, frame = refinement.before, refinement.frame
        owner = _owner(clusters, frame, point_counts(clusters))
        nowhere = np.zeros(owner.shape, np.bool_)
        return cls("before", clusters, _colors(len(clusters)), owner, nowhere, nowhere)

    @classmethod
    def after(cls, refinement: Refinement) -> _Column:
        before, after, frame = refinement.before, refinement.after, refinement.frame
        # points that come from the same cluster's same pixel are the same
        origin = np.append(refinement.origin, -1)[after.cluster]
        size = frame.depth.size
        keys_before = before.cluster.astype(np.int64) * size + pixel_index(before, frame)
        keys_after = origin.astype(np.int64) * size + pixel_index(after, frame)
        new = ~np.isin(keys_after, keys_before[before.cluster >= 0])
        sizes = point_counts(after)
        owner = _owner(after, frame, sizes)
        added = _painted(after, frame, sizes, new, False)
        was = _owner(before, frame, refinement.points_before) >= 0
        return cls("after", after, _colors_after(refinement), owner, was & (owner < 0), np.asarray(added, np.bool_))

    def mask(self, k: int) -> Bool:
        """(H, W) of cluster k."""
        mask = np.zeros(self.owner.shape, np.bool_)
        u, v = self.clusters.pixels[self.clusters.cluster == k].T
        mask[v, u] = True
        return mask

    def by_size(self) -> list[int]:
        """The clusters that have points, the largest first."""
        sizes = point_counts(self.clusters)
        order = np.argsort(-sizes, kind="stable")
        return [k for k in order.tolist() if sizes[k]]


def _name(clusters: PointClusters, k: int) -> str:
    """Class and score of cluster k."""
    probabilities = clusters.class_probabilities[k]
    label = clusters.classes[int(probabilities.argmax())] if len(probabilities) else "object"
    return f"{label} {clusters.scores[k]:.2f}"


def _colors(count: int) -> UInt8:
    """(count, 3) colours unlike each other, wherever the objects are: in the view from the side all are near.

    The first of the palette is a red; it is left out, because red marks what was dropped.
    """
    return np.asarray(instance_colors(np.zeros((count + 1, 3)))[1:], np.uint8)


def _colors_after(refinement: Refinement) -> UInt8:
    """(M, 3) the largest part of a cluster keeps its colour; further parts, and clusters from nowhere, get new ones."""
    n, m = len(refinement.before), len(refinement.after)
    place = np.full(m, -1)
    known = np.flatnonzero(refinement.main_part >= 0)
    place[refinement.main_part[known]] = known
    place[place < 0] = n + np.arange((place < 0).sum())
    return np.asarray(_colors(n + m)[place])


def _owner(clusters: PointClusters, frame: Frame, sizes: Int32) -> Int32:
    """(H, W) the smallest cluster over each pixel, -1 = none."""
    return np.asarray(_painted(clusters, frame, sizes, clusters.cluster, -1), np.int32)


def _painted(clusters: PointClusters, frame: Frame, sizes: Int32, values: Array, nothing: int) -> Array:
    """(H, W) the values (P,) of the points, those of small clusters over those of large ones."""
    held = np.flatnonzero(clusters.cluster >= 0)
    held = held[np.argsort(-sizes[clusters.cluster[held]], kind="stable")]
    image = np.full(frame.depth.size, nothing, values.dtype)
    image[pixel_index(clusters, frame)[held]] = values[held]  # of several the last one stays
    return image.reshape(frame.depth.shape)


# The image


def _image_panel(frame: Frame, column: _Column) -> UInt8:
    height, width = frame.depth.shape
    scale = min(PANEL_WIDTH / width, IMAGE_HEIGHT_MAX / height)
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
        cv2.polylines(canvas, border, True, _rgb(0.62 * column.colors[k]), round(1.6 * SUPERSAMPLING), cv2.LINE_AA)
    picture = Image.fromarray(_developed(canvas, size))
    panel = Image.new("RGB", (PANEL_WIDTH, size[0]), PAPER)
    left = (PANEL_WIDTH - size[1]) // 2
    _tag_clusters(picture, column)
    panel.paste(picture, (left, 0))
    _heading(panel, column.heading, left)
    _key(panel, column, left)
    return np.asarray(panel)


def _filled(mask: Bool, depth: Float32) -> Bool:
    """A cluster has no pixels without a reading: single ones are filled, so that its outline is one line."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
    return np.asarray(mask | (closed & (depth == 0)))


def _enlarged(mask: Bool, shape: tuple[int, int]) -> Bool:
    """A mask (h, w) at another size, its border smooth."""
    return np.asarray(cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5)


def _developed(drawn: Array, size: tuple[int, int]) -> UInt8:
    """What was drawn too large, (h, w, 3), at its height and width in the picture."""
    return np.asarray(cv2.resize(drawn, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)


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


def _tag_clusters(picture: Image.Image, column: _Column) -> None:
    """Names each cluster where it shows, the large ones first; a tag moves aside for those already there."""
    canvas, font = ImageDraw.Draw(picture), _font(TAG_PX)
    scale = picture.width / column.owner.shape[1]
    taken = [(0.0, 0.0, 110.0, 40.0), (0.0, picture.height - 40.0, 230.0, float(picture.height))]  # heading and key
    for k in column.by_size():
        v, u = np.nonzero(column.owner == k)
        if len(u) == 0:
            continue
        name = _name(column.clusters, k)
        size = canvas.textlength(name, font) + 12, TAG_PX + 7.0
        middle = np.hypot(u - u.mean(), v - v.mean()).argmin()
        at = u[middle] * scale, v[middle] * scale
        if len(u) * scale**2 < 4 * size[0] * size[1]:  # it would be hidden: the tag goes above
            at = u.mean() * scale, v.min() * scale - size[1] / 2 - 5
        box = _free_place(at, size, picture.size, taken)
        if box is None:
            continue
        taken.append(box)
        rgb = column.colors[k].astype(float)
        canvas.rounded_rectangle(box, 4, fill=_rgb(0.35 * rgb + 0.65 * 255), outline=_rgb(0.62 * rgb))
        canvas.text(((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), name, INK, font, anchor="mm")


def _free_place(
    middle: tuple[float, float],
    size: tuple[float, float],
    room: tuple[int, int],
    taken: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float] | None:
    """The box nearest to `middle` that overlaps no other one; None where there is none near."""
    steps = [(dx, dy) for dy in range(-4, 5) for dx in range(-3, 4)]
    for dx, dy in sorted(steps, key=lambda step: (abs(step[0]) * size[0] / 2 + abs(step[1]) * size[1], step)):
        x = min(max(middle[0] + dx * size[0] / 2, size[0] / 2 + 2), room[0] - size[0] / 2 - 2)
        y = min(max(middle[1] + dy * (size[1] + 3), size[1] / 2 + 2), room[1] - size[1] / 2 - 2)
        box = (x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2)
        if not any(box[0] < b[2] + 2 and b[0] < box[2] + 2 and box[1] < b[3] + 2 and b[1] < box[3] + 2 for b in taken):
            return box
    return None


def _heading(panel: Image.Image, text: str, left: int = 0) -> None:
    canvas, font = ImageDraw.Draw(panel), _font(TEXT_PX, bold=True)
    width = canvas.textlength(text, font) + 20
    canvas.rounded_rectangle((left + 8, 8, left + 8 + width, 36), 4, fill=PAPER)
    canvas.text((left + 18, 22), text, INK, font, anchor="lm")


def _key(panel: Image.Image, column: _Column, left: int) -> None:
    """What the hatchings mean, in the lower left corner; only those that there are."""
    shown = [("dropped", PAPER, DROPPED, False)] if column.dropped.any() else []
    shown += [("added", SOME_COLOR, WHITE, True)] if column.added.any() else []
    if not shown:
        return
    canvas, font = ImageDraw.Draw(panel), _font(TAG_PX)
    widths = [canvas.textlength(text, font) + 44 for text, *_ in shown]
    bottom = panel.height - 8
    canvas.rounded_rectangle((left + 8, bottom - 28, left + 8 + sum(widths) + 6, bottom), 4, fill=PAPER)
    x = left + 18.0
    for (text, ground, color, falling), width in zip(shown, widths, strict=True):
        swatch = np.tile(np.array(ground, np.float32), (16 * SUPERSAMPLING, 22 * SUPERSAMPLING, 1))
        _hatch(swatch, np.ones(swatch.shape[:2], np.bool_), color, 1.0, falling)
        panel.paste(Image.fromarray(_developed(swatch, (16, 22))), (round(x), bottom - 22))
        canvas.text((x + 28, bottom - 14), text, INK, font, anchor="lm")
        x += width


# From the side


@dataclass(frozen=True)
class _Side:
    """Where the frame's P readings are seen from the side, in a picture of the finer size."""

    places: tuple[Array, Array]  # (P,) rows and (P,) columns of the readings in the frame
    pixels: Float32  # (P, 2) u v
    depth: Float32  # (P,) m
    radius: Float32  # (P,) px
    scale: float  # px a meter
    forward: Float64  # (2,) where the frame's camera looked, in the picture; 1 = in its plane

    @classmethod
    def of(cls, frame: Frame, before: _Column, after: _Column) -> _Side | None:
        """The view from the left or the right: where more of what has changed shows. None without any reading."""
        rows, columns = np.nonzero(frame.depth)
        if len(rows) == 0:
            return None
        z = frame.depth[rows, columns]
        points = back_project(frame.camera, np.stack([columns, rows], axis=1).astype(np.int32), z)
        claimed = (before.owner[rows, columns] >= 0) | (after.owner[rows, columns] >= 0)
        changed = (after.dropped | after.added)[rows, columns]
        up = _up(frame)
        spacing = z / np.float32(min(frame.camera.fx, frame.camera.fy))
        sides = []
        for azimuth in (-AZIMUTH_RAD, AZIMUTH_RAD):
            R_camera_view = _turned(up, azimuth)
            shape = SIDE_HEIGHT * SUPERSAMPLING, PANEL_WIDTH * SUPERSAMPLING
            shown = points[claimed] if claimed.any() else points
            pixels, depth, scale = orthographic(points, R_camera_view, shown, shape, SIDE_MARGIN, LEAST_EXTENT_M)
            radius = np.clip(0.6 * spacing * scale, SUPERSAMPLING, 3 * SUPERSAMPLING).astype(np.float32)
            forward = np.array([R_camera_view[2, 0], R_camera_view[2, 1]])
            side = cls((rows, columns), pixels, depth, radius, scale, forward)
            nearest, _ = side.seen(claimed)
            sides.append((np.count_nonzero(np.append(changed, False)[nearest]), side))
        return max(sides, key=lambda scored: scored[0])[1]

    def seen(self, chosen: Bool) -> tuple[Int32, Float32]:
        """`splat` of the chosen readings (P,), with their index among all."""
        index = np.flatnonzero(chosen).astype(np.int32)
        shape = SIDE_HEIGHT * SUPERSAMPLING, PANEL_WIDTH * SUPERSAMPLING
        nearest, buffer = splat(self.pixels[chosen], self.depth[chosen], self.radius[chosen], shape)
        return np.append(index, np.int32(-1))[nearest], buffer


def _up(frame: Frame) -> Float64:
    """(3,) the direction up in the camera's frame, straightened by the floor and table tops that it sees."""
    step = LEVEL_STEP_PX
    depth = frame.depth[::step, ::step]
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.int32) * step
    vertices = back_project(frame.camera, pixels, depth.ravel())
    corner = (v[:-1, :-1] * width + u[:-1, :-1]).ravel()
    triangles = np.stack([corner, corner + width, corner + 1], axis=1).astype(np.int32)  # their front to the camera
    z = depth.ravel()[triangles]
    whole = (z.min(axis=1, initial=np.inf) > 0) & (np.ptp(z, axis=1) < 0.1 * z[:, 0]) if len(z) else np.zeros(0, bool)
    return upward(np.eye(4)[None], Surface(vertices, triangles[whole]))


def _turned(up: Float64, azimuth: float) -> Float64:
    """(3, 3) the axes of a view that is turned by `azimuth` about the vertical, and looks slightly down."""
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < 0.1:  # the camera looks straight down or up
        forward = np.array([0.0, -1.0, 0.0]) + up[1] * up
    forward /= np.linalg.norm(forward)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(forward, up)
    return looking(np.cos(ELEVATION_RAD) * level - np.sin(ELEVATION_RAD) * up, up)


def _side_panel(frame: Frame, column: _Column, side: _Side | None) -> UInt8:
    if side is None:
        panel = Image.new("RGB", (PANEL_WIDTH, SIDE_HEIGHT), NOTHING)
        text = "no depth reading in this frame"
        ImageDraw.Draw(panel).text((PANEL_WIDTH / 2, SIDE_HEIGHT / 2), text, FAINT_INK, _font(TEXT_PX), anchor="mm")
        return np.asarray(panel)
    gray = frame.color[side.places].mean(axis=1, keepdims=True, dtype=np.float32)
    owner, dropped, added = (image[side.places] for image in (column.owner, column.dropped, column.added))
    shape = SIDE_HEIGHT * SUPERSAMPLING, PANEL_WIDTH * SUPERSAMPLING
    drawn = np.tile(np.array(NOTHING, np.float32), (*shape, 1))
    background, clusters = (owner < 0) & ~dropped, (owner >= 0) | dropped
    color = 0.12 * gray + 196.0 + np.zeros(3, np.float32)
    color[owner >= 0] = column.colors[owner[owner >= 0]] * (0.80 + 0.20 * gray[owner >= 0] / 140)
    color[added] = 0.55 * color[added] + 0.45 * 255
    color[dropped] = DROPPED
    # the clusters last: what stands before them must not hide them, nor draw the eye by its shading
    for layer, contrast in ((background, 0.4), (clusters, 1.0)):
        nearest, buffer = side.seen(layer)
        lit = shading(buffer) ** contrast
        there = nearest >= 0
        drawn[there] = np.clip(color[nearest[there]] * lit[there, None], 0, 255)
    panel = Image.fromarray(_developed(drawn, (SIDE_HEIGHT, PANEL_WIDTH)))
    _heading(panel, f"{column.heading}, from the side")
    _scale_bar(panel, side)
    return np.asarray(panel)


def _scale_bar(panel: Image.Image, side: _Side) -> None:
    """A length in meters, and an arrow where the camera looked."""
    canvas, font = ImageDraw.Draw(panel), _font(TAG_PX)
    scale = side.scale / SUPERSAMPLING
    length = min(SCALE_BARS_M, key=lambda m: abs(math.log(m * scale / 110)))
    right, y = PANEL_WIDTH - 18, SIDE_HEIGHT - 20
    left = right - length * scale
    canvas.rounded_rectangle((left - 236, y - 14, right + 10, y + 12), 4, fill=PAPER)
    canvas.line((left, y, right, y), INK, 2)
    for x in (left, right):
        canvas.line((x, y - 5, x, y + 5), INK, 2)
    canvas.text((left - 10, y), f"{length:g} m", INK, font, anchor="rm")
    towards = 1 if side.forward[0] > 0 else -1
    x = left - 104.0
    canvas.line((x - 14, y, x + 14, y), INK, 2)
    tip = x + 16 * towards
    canvas.polygon([(tip, y), (tip - 9 * towards, y - 5), (tip - 9 * towards, y + 5)], fill=INK)
    canvas.text((x - 24, y), "camera looks", INK, font, anchor="rm")


# Words and figures


def _figures(refinement: Refinement, refiner: str) -> UInt8:
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
    canvas, bold, font = ImageDraw.Draw(image), _font(TEXT_PX, bold=True), _font(TEXT_PX)
    text = "   ·   ".join(parts)
    room = WIDTH - 2 * MARGIN - canvas.textlength(text, font) - 30
    y = FIGURES_HEIGHT / 2
    canvas.text((MARGIN, y), _shortened(refiner, canvas, bold, room), INK, bold, anchor="lm")
    canvas.text((WIDTH - MARGIN, y), text, INK, font, anchor="rm")
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


def _table(refinement: Refinement, column: _Column) -> UInt8:
    """What happened to each cluster, in the order of the detections."""
    n, places = len(refinement.before), TABLE_COLUMNS * TABLE_ROWS_MAX
    told = n if n <= places else places - 1
    rows = -(-min(n, places) // TABLE_COLUMNS)
    image = Image.new("RGB", (WIDTH, ROW_HEIGHT * (rows + 1 if rows else 0)), PAPER)
    canvas, font, small = ImageDraw.Draw(image), _font(TEXT_PX), _font(TAG_PX)
    step = (WIDTH - 2 * MARGIN) / TABLE_COLUMNS
    name_at, points_at, iou_at = 24, 184, step - 24  # px in a column; the last one is where it ends
    was, now = refinement.fit_before, refinement.fit_after
    for k in range(told):
        x, y = MARGIN + step * (k // rows), ROW_HEIGHT * (k % rows + 1.5)
        if k % rows == 0:
            canvas.text((x + points_at, ROW_HEIGHT / 2), "points", FAINT_INK, small, anchor="lm")
            if was is not None:
                canvas.text((x + iou_at, ROW_HEIGHT / 2), "IoU with the true mask", FAINT_INK, small, anchor="rm")
        canvas.rounded_rectangle((x, y - 8, x + 16, y + 8), 4, fill=_rgb(column.colors[k]))
        name = _shortened(_name(column.clusters, k), canvas, font, points_at - name_at - 8)
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
    if told < n:
        x, y = MARGIN + step * (TABLE_COLUMNS - 1), ROW_HEIGHT * (rows + 0.5)
        canvas.text((x, y), f"and {n - told} more", FAINT_INK, font, anchor="lm")
    return np.asarray(image)


def _title(text: str) -> UInt8:
    image = Image.new("RGB", (WIDTH, TITLE_HEIGHT), PAPER)
    canvas, font = ImageDraw.Draw(image), _font(TITLE_PX)
    text = _shortened(text, canvas, font, WIDTH - 2 * MARGIN)
    canvas.text((MARGIN, TITLE_HEIGHT / 2), text, INK, font, anchor="lm")
    return np.asarray(image)


def _shortened(text: str, canvas: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont, room: float) -> str:
    """The text, or its beginning and an ellipsis where the room, px, is too small."""
    if canvas.textlength(text, font) <= room:
        return text
    while text and canvas.textlength(f"{text}…", font) > room:
        text = text[:-1]
    return f"{text}…"


def _beside(panels: Sequence[UInt8]) -> UInt8:
    height = panels[0].shape[0]
    row = np.tile(np.array(PAPER, np.uint8), (height, WIDTH, 1))
    for k, panel in enumerate(panels):
        left = MARGIN + k * (PANEL_WIDTH + GAP)
        row[:, left : left + PANEL_WIDTH] = panel
    return row


def _blank(height: int) -> UInt8:
    return np.tile(np.array(PAPER, np.uint8), (height, WIDTH, 1))


def _rgb(color: Array) -> tuple[int, int, int]:
    red, green, blue = np.rint(color).astype(int).tolist()
    return red, green, blue


def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / name), size)
