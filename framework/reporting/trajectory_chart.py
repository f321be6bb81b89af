"""The camera's way from above, beside the true one, and how far they are from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from framework.data import Box, Float64
from framework.reporting import svg

WIDTH, HEIGHT, FLAT_HEIGHT = 560.0, 380.0, 180.0  # of the viewBox
FOOT = 36.0  # of a view from above, for its scale
AROUND = 0.08  # of the size of what is shown, free around it
SMALLEST_M = 0.04  # that the shorter side of the picture shows
NAMED_PX = 46.0  # the width of a footprint that has its name written on it
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
LEFT, RIGHT, TOP, BOTTOM = 46.0, 12.0, 24.0, 34.0


@dataclass(frozen=True)
class Footprint:
    """An object from above."""

    corners_world: Float64  # (8, 3) m
    name: str
    color: str  # #rrggbb


@dataclass(frozen=True)
class Way:
    """One camera's way."""

    positions: Float64  # (P, 3) m, world
    css_class: str
    lost_after: Sequence[int] = ()  # positions after which the pose was not known for a while


def box_corners(box: Box) -> Float64:
    """(8, 3) m."""
    return np.asarray(box.center + (CORNERS * box.extent) @ box.rotation.T)


def top_view(
    ways: Sequence[Way],
    true_ways: Sequence[Float64],
    objects: Sequence[Footprint],
    up: Float64,
    height: float = HEIGHT,
) -> tuple[str, float]:
    """The ways from above, the true ones dashed, among objects; and how long the ways are, as a share of its width."""
    room = height - FOOT
    plane = _horizontal(ways[0].positions, up)
    shown = np.concatenate([way.positions for way in ways] + list(true_ways)) @ plane.T
    low, high = shown.min(axis=0), shown.max(axis=0)
    way_size = float((high - low).max())
    if objects:
        corners = np.concatenate([one.corners_world for one in objects]) @ plane.T
        low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    middle, size = (low + high) / 2, (high - low) * (1 + 2 * AROUND)
    scale = min(WIDTH / max(size[0], SMALLEST_M * WIDTH / room), room / max(size[1], SMALLEST_M))

    def pixels(points_world: Float64) -> Float64:
        flat = (points_world @ plane.T - middle) * scale
        return np.asarray(np.stack([WIDTH / 2 + flat[:, 0], room / 2 - flat[:, 1]], axis=1))

    parts = [_footprint(one, pixels(one.corners_world)) for one in objects]
    parts += [svg.path(pixels(positions), class_="way truth") for positions in true_ways]
    for way in ways:
        points = pixels(way.positions)
        parts += [svg.path(points, class_=f"way {way.css_class}")]
        parts += [svg.element("circle", cx=u, cy=v, r=4, class_="lost") for u, v in points[list(way.lost_after)]]
        start, end = points[0].tolist(), points[-1].tolist()
        parts += [svg.element("circle", cx=start[0], cy=start[1], r=5, class_="start")]
        parts += [svg.element("circle", cx=end[0], cy=end[1], r=5, class_="end")]
    length = svg.round_step(0.12 * WIDTH / scale, 1)
    bar = np.array([[16.0, height - 8.0], [16.0 + length * scale, height - 8.0]])
    label = f"{svg.number(length)} m" if length >= 1 else f"{svg.number(100 * length)} cm"
    parts += [svg.path(bar, class_="scale"), svg.text(16, height - 16, label, class_="tick")]
    return svg.diagram(WIDTH, height, "The camera's way from above", parts), way_size * scale / WIDTH


def error_over_time(frames: Sequence[int], errors: Float64, height: float = FLAT_HEIGHT) -> str:
    """How far from the true way each of the frames is, errors (n,) m."""
    highest = max(float(1e3 * errors.max(initial=0.0)), 1e-3)
    step = svg.ticks(0, highest * 1.05, 3)
    top = max(highest * 1.08, step[-1])
    first, last = frames[0], max(frames[-1], frames[0] + 1)
    right, bottom = WIDTH - RIGHT, height - BOTTOM
    u = LEFT + (np.array(frames) - first) / (last - first) * (right - LEFT)
    v = bottom - 1e3 * errors / top * (bottom - TOP)
    parts = []
    for value in step:
        y = bottom - value / top * (bottom - TOP)
        parts += [svg.path(np.array([[LEFT, y], [right, y]]), class_="grid")]
        parts += [svg.text(LEFT - 8, y + 4, svg.number(value), class_="tick", text_anchor="end")]
    parts += [frame_axis(first, last, LEFT, right, bottom)]
    parts += [svg.path(np.stack([u, v], axis=1), class_="way mine")]
    parts += [svg.text(LEFT, 12, "mm from the true position", class_="tick")]
    return svg.diagram(WIDTH, height, "The distance from the true position over the frames", parts)


def frame_axis(first: float, last: float, left: float, right: float, bottom: float) -> str:
    """The frames' numbers below a diagram."""
    parts = [svg.path(np.array([[left, bottom], [right, bottom]]), class_="axis")]
    for value in svg.ticks(first, last, 6):
        u = left + (value - first) / (last - first) * (right - left)
        parts += [svg.text(u, bottom + 16, svg.number(value), class_="tick", text_anchor="middle")]
    parts += [svg.text(right, bottom + 31, "frame", class_="tick", text_anchor="end")]
    return "".join(parts)


def _horizontal(positions: Float64, up: Float64) -> Float64:
    """(2, 3) the directions to the right and away in a view from above in which the way is as wide as can be."""
    any_level = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    level = np.stack([any_level, np.cross(up, any_level)]) / np.linalg.norm(any_level)
    flat = (positions - positions.mean(axis=0)) @ level.T
    _, _, Vt = np.linalg.svd(flat, full_matrices=True)
    right = Vt[0] * (np.sign(Vt[0][np.abs(Vt[0]).argmax()]) or 1.0)
    away = np.array([-right[1], right[0]])
    return np.asarray(np.stack([right, away]) @ level)


def _footprint(one: Footprint, corners: Float64) -> str:
    try:
        outline = corners[ConvexHull(corners).vertices]
    except QhullError:  # an object that is a line from above
        return ""
    title = svg.element("title", escape(one.name))
    parts = [title, svg.path(outline, closed=True, class_="footprint", fill=one.color, stroke=one.color)]
    if np.ptp(outline[:, 0]) > NAMED_PX:
        u, v = outline.mean(axis=0).tolist()
        parts.append(svg.text(u, v + 4, one.name, class_="tick", text_anchor="middle"))
    return svg.element("g", *parts)
