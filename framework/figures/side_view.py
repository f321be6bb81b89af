"""A frame's readings and clusters from the side, where it shows what lies behind what."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from framework.data import Array, Bool, Float32, Float64, Frame, Int32, UInt8
from framework.figures.cluster_marks import ClusterMarks
from framework.figures.drawing import (
    DROPPED,
    PANEL_WIDTH,
    SUPERSAMPLING,
    TAG_PX,
    TEXT_PX,
    downsampled,
    draw_heading,
    font_of,
)
from framework.figures.point_cloud import orthographic, shading, splat
from framework.geometry import back_project
from framework.rendering.lit_view import NOTHING
from framework.rendering.palette import FAINT_INK, INK, PAPER
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import looking, upward

HEIGHT = 460  # px
SHAPE = HEIGHT * SUPERSAMPLING, PANEL_WIDTH * SUPERSAMPLING  # of what is drawn
AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(75), np.deg2rad(14)  # 90 would be exactly from the side: planes become lines
FREE = 0.09  # share of the picture around the clusters
LEAST_EXTENT_M = 0.4  # a single point is not enlarged without end
POINT_SIZE = 0.6  # radius of a point, in distances between readings
LEVEL_CELLS = 120  # across the coarse surface in which the floor is looked for
LEVEL_RAD = np.deg2rad(6)  # how oblique a floor may be
PITCHES_RAD = np.deg2rad([0, 30])  # how far down the camera is taken to look when its floor is looked for
LEVEL_JUMP = 0.1  # of depth, between readings that are not one surface
SCALE_BARS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
SCALE_BAR_PX = 110  # about


@dataclass(frozen=True)
class SideView:
    """Where the frame's P readings are seen from the side, in a picture of the finer size."""

    places: tuple[Array, Array]  # (P,) rows and (P,) columns of the readings in the frame
    pixels: Float32  # (P, 2) u v
    depth: Float32  # (P,) m
    radius: Float32  # (P,) px
    scale: float  # px a meter
    forward: Float64  # (2,) where the frame's camera looked, in the picture; 1 = in its plane

    @classmethod
    def of(cls, frame: Frame, before: ClusterMarks, after: ClusterMarks) -> SideView | None:
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
            shown = points[claimed] if claimed.any() else points
            pixels, depth, scale = orthographic(points, R_camera_view, shown, SHAPE, FREE, LEAST_EXTENT_M)
            radius = np.clip(POINT_SIZE * spacing * scale, SUPERSAMPLING, 3 * SUPERSAMPLING).astype(np.float32)
            forward = np.array([R_camera_view[2, 0], R_camera_view[2, 1]])
            side = cls((rows, columns), pixels, depth, radius, scale, forward)
            nearest, _ = side.seen(claimed)
            sides.append((np.count_nonzero(np.append(changed, False)[nearest]), side))
        return max(sides, key=lambda scored: scored[0])[1]

    def seen(self, chosen: Bool) -> tuple[Int32, Float32]:
        """`splat` of the chosen readings (P,), with their index among all."""
        index = np.flatnonzero(chosen).astype(np.int32)
        nearest, buffer = splat(self.pixels[chosen], self.depth[chosen], self.radius[chosen], SHAPE)
        return np.append(index, np.int32(-1))[nearest], buffer


def _up(frame: Frame) -> Float64:
    """(3,) the direction up in the camera's frame, straightened by the floor and table tops that it sees."""
    step = max(1, min(frame.depth.shape) // LEVEL_CELLS)
    depth = frame.depth[::step, ::step]
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.int32) * step
    vertices = back_project(frame.camera, pixels, depth.ravel())
    corner = (v[:-1, :-1] * width + u[:-1, :-1]).ravel()
    triangles = np.stack([corner, corner + width, corner + 1], axis=1).astype(np.int32)  # their front to the camera
    z = depth.ravel()[triangles]
    whole = (z.min(axis=1) > 0) & (np.ptp(z, axis=1) < LEVEL_JUMP * z[:, 0])
    surface = Surface(vertices, triangles[whole])
    found = [upward(_pitched(angle)[None], surface) for angle in PITCHES_RAD]
    return max(found, key=lambda up: _level_area(surface, up))


def _pitched(angle: float) -> Float64:
    """(4, 4) a level camera, as seen from one that looks down by `angle`."""
    T = np.eye(4)
    T[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


def _level_area(surface: Surface, up: Float64) -> float:
    """m^2 of the surface that faces upwards."""
    areas = np.linalg.norm(surface.face_normals, axis=1)
    return float(areas[surface.face_normals @ up > np.cos(LEVEL_RAD) * areas].sum() / 2)


def _turned(up: Float64, azimuth: float) -> Float64:
    """(3, 3) the axes of a view that is turned by `azimuth` about the vertical, and looks slightly down."""
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < 0.1:  # the camera looks straight down or up
        forward = np.array([0.0, -1.0, 0.0]) + up[1] * up
    forward /= np.linalg.norm(forward)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(forward, up)
    return looking(np.cos(ELEVATION_RAD) * level - np.sin(ELEVATION_RAD) * up, up)


def side_panel(frame: Frame, column: ClusterMarks, side: SideView | None) -> UInt8:
    """(HEIGHT, PANEL_WIDTH, 3) RGB."""
    if side is None:
        panel = Image.new("RGB", (PANEL_WIDTH, HEIGHT), NOTHING)
        text = "no depth reading in this frame"
        ImageDraw.Draw(panel).text((PANEL_WIDTH / 2, HEIGHT / 2), text, FAINT_INK, font_of(TEXT_PX), anchor="mm")
        return np.asarray(panel)
    gray = frame.color[side.places].mean(axis=1, keepdims=True, dtype=np.float32)
    owner, dropped, added = (image[side.places] for image in (column.owner, column.dropped, column.added))
    drawn = np.tile(np.array(NOTHING, np.float32), (*SHAPE, 1))
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
    panel = Image.fromarray(downsampled(drawn, (HEIGHT, PANEL_WIDTH)))
    draw_heading(panel, f"{column.heading}, from the side")
    _scale_bar(panel, side)
    return np.asarray(panel)


def _scale_bar(panel: Image.Image, side: SideView) -> None:
    """A length in meters, and an arrow where the camera looked."""
    canvas, font = ImageDraw.Draw(panel), font_of(TAG_PX)
    scale = side.scale / SUPERSAMPLING
    length = min(SCALE_BARS_M, key=lambda m: abs(math.log(m * scale / SCALE_BAR_PX)))
    right, y = PANEL_WIDTH - 18, HEIGHT - 20
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
