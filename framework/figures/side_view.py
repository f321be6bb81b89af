"""Side view of a frame's depth readings and clusters, to make depth differences visible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from framework.data import Array, Float32, Float64, Frame
from framework.figures.cluster_marks import DROPPED, ClusterMarks
from framework.figures.figure_page import FAINT_INK, INK
from framework.geometry import back_project
from framework.rendering.lit_view import NOTHING
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import looking, upward

# direction of the view; at an azimuth of 90 degrees, surfaces that face the camera would become lines
AZIMUTH_RAD, ELEVATION_RAD = np.deg2rad(75), np.deg2rad(14)
MARGIN = 0.09  # margin around the clusters, as a fraction of the size of the view
MIN_HEIGHT_M = 0.4  # minimum height of the view
CELLS = 300  # number of grid cells across the view for counting visible points
POINT_SIZE = 1.2  # size of a drawn point, as a multiple of the distance between readings
MIN_POINT_PT, MAX_POINT_PT = 0.7, 2.2  # minimum and maximum size of a drawn point
GRID_CELLS = 120  # number of grid cells across the coarse surface for estimating the up direction
LEVEL_RAD = np.deg2rad(6)  # maximum slope of a floor
PITCHES_RAD = np.deg2rad([0, 30])  # initial downward pitches of the camera in the floor search
MAX_DEPTH_STEP = 0.1  # maximum difference between neighboring readings of one surface, as a fraction of the depth
SCALE_BARS_M = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0])  # possible lengths of the scale bar
SCALE_BAR = 0.15  # approximate length of the scale bar, as a fraction of the width of the view


@dataclass(frozen=True)
class SideView:
    """Orthographic side view of the P depth readings of a frame."""

    rows: Array  # (P,) image rows of the readings
    columns: Array  # (P,) image columns of the readings
    points: Float32  # (P, 3) m, in the frame of the view: x right, y down, z forward
    spacing: Float32  # (P,) m, distance between neighboring readings
    center: Float64  # (2,) m, x and y of the center of the view
    size: Float64  # (2,) m, width and height of the view
    forward: float  # x component of the camera's viewing direction, in the frame of the view

    @classmethod
    def of(cls, frame: Frame, before: ClusterMarks, after: ClusterMarks, aspect: float) -> SideView | None:
        """Return the view from the left or from the right, whichever shows more changed points.

        Returns None if the frame has no depth readings.

        Args:
            frame: Frame with depth.
            before: Clusters before refinement.
            after: Clusters after refinement.
            aspect: Width of the view divided by its height.
        """
        rows, columns = np.nonzero(frame.depth)
        if len(rows) == 0:
            return None
        z = frame.depth[rows, columns]
        points = back_project(frame.camera, np.stack([columns, rows], axis=1).astype(np.int32), z)
        claimed = (before.owner[rows, columns] >= 0) | (after.owner[rows, columns] >= 0)
        changed = (after.dropped | after.added)[rows, columns]
        shown = claimed if claimed.any() else z > 0
        spacing = z / np.float32(min(frame.camera.fx, frame.camera.fy))
        up = _up(frame)
        sides = []
        for azimuth in (-AZIMUTH_RAD, AZIMUTH_RAD):
            R_camera_view = _turned(up, azimuth)
            seen = points @ R_camera_view.astype(np.float32)
            low, high = np.percentile(seen[shown, :2], [0.5, 99.5], axis=0)
            extent = high - low
            height = max(extent[0] / aspect, extent[1], MIN_HEIGHT_M) / (1 - 2 * MARGIN)
            size = np.array([aspect * height, height])
            side = cls(rows, columns, seen, spacing, (low + high) / 2, size, float(R_camera_view[2, 0]))
            front = np.flatnonzero(claimed)[np.argsort(seen[claimed, 2])]
            cells = np.floor(seen[front, :2] * (CELLS / size[0])).astype(np.int64)
            _, nearest = np.unique(cells, axis=0, return_index=True)
            sides.append((np.count_nonzero(changed[front[nearest]]), side))
        return max(sides, key=lambda scored: scored[0])[1]


def draw_side(axes: Axes, frame: Frame, marks: ClusterMarks, side: SideView | None, height_in: float) -> None:
    """Draw the readings as points, with a scale bar. Clusters are colored and drawn in front of all other readings."""
    axes.set_facecolor(np.array(NOTHING) / 255)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    if side is None:
        message = "no depth readings in this frame"
        axes.text(0.5, 0.5, message, transform=axes.transAxes, ha="center", va="center", fontsize=12, color=FAINT_INK)
        return
    left, top = side.center - side.size / 2
    axes.set(xlim=(left, left + side.size[0]), ylim=(top + side.size[1], top))
    diameter = np.clip(POINT_SIZE * side.spacing * 72 * height_in / side.size[1], MIN_POINT_PT, MAX_POINT_PT)

    gray = frame.color[side.rows, side.columns].mean(axis=1, keepdims=True)
    owner, dropped, added = (image[side.rows, side.columns] for image in (marks.owner, marks.dropped, marks.added))
    colors = 0.25 * gray + 170 + np.zeros(3)
    colors[owner >= 0] = marks.colors[owner[owner >= 0]] * (0.65 + 0.35 * gray[owner >= 0] / 140)
    colors[added] = 0.55 * colors[added] + 0.45 * 255
    colors[dropped] = DROPPED
    clustered = (owner >= 0) | dropped
    for layer in (~clustered, clustered):
        order = np.flatnonzero(layer)
        order = order[np.argsort(-side.points[order, 2], kind="stable")]
        x, y, _ = side.points[order].T
        axes.scatter(x, y, diameter[order] ** 2, np.clip(colors[order] / 255, 0, 1), marker="s", linewidths=0)
    length = float(SCALE_BARS_M[np.abs(np.log(SCALE_BARS_M / (SCALE_BAR * side.size[0]))).argmin()])
    arrow = "\N{RIGHTWARDS ARROW}" if side.forward > 0 else "\N{LEFTWARDS ARROW}"
    right, y = np.array([left, top]) + [0.98, 0.95] * side.size
    axes.plot([right - length, right], [y, y], "|-", color=INK)
    style: dict[str, Any] = {"ha": "right", "va": "center", "fontsize": 11, "color": INK}
    axes.text(right - length, y, f"camera direction {arrow}    {length:g} m  ", **style)


def _up(frame: Frame) -> Float64:
    """Return the up direction (3,) in the camera frame, estimated from visible floors and table tops."""
    step = max(1, min(frame.depth.shape) // GRID_CELLS)
    depth = frame.depth[::step, ::step]
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.int32) * step
    vertices = back_project(frame.camera, pixels, depth.ravel())
    corner = (v[:-1, :-1] * width + u[:-1, :-1]).ravel()
    triangles = np.stack([corner, corner + width, corner + 1], axis=1).astype(np.int32)  # front faces the camera
    z = depth.ravel()[triangles]
    connected = (z.min(axis=1) > 0) & (np.ptp(z, axis=1) < MAX_DEPTH_STEP * z[:, 0])
    surface = Surface(vertices, triangles[connected])
    areas = np.linalg.norm(surface.face_normals, axis=1)
    candidates = []
    for pitch in PITCHES_RAD:
        T_camera_level = np.eye(4)
        T_camera_level[1:3, 1:3] = [[np.cos(pitch), -np.sin(pitch)], [np.sin(pitch), np.cos(pitch)]]
        up = upward(T_camera_level[None], surface)
        level_area = areas[surface.face_normals @ up > np.cos(LEVEL_RAD) * areas].sum()
        candidates.append((level_area, up))
    return max(candidates, key=lambda scored: scored[0])[1]


def _turned(up: Float64, azimuth: float) -> Float64:
    """Return R_camera_view (3, 3): a rotation by `azimuth`, rad, about `up` (3,), and a pitch ELEVATION_RAD down."""
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < 0.1:  # the camera looks straight down or up
        forward = np.array([0.0, -1.0, 0.0]) + up[1] * up
    forward /= np.linalg.norm(forward)
    level = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(forward, up)
    return looking(np.cos(ELEVATION_RAD) * level - np.sin(ELEVATION_RAD) * up, up)
