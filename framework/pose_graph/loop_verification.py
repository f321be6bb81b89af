"""Verification of loops: alignment of a frame to the view of hidden submaps.

A wrong loop ruins a map, and a missed one only leaves it as it is. So all checks must pass: enough of the frame sees
the submaps, the visible surface determines all directions of motion, and depth agrees in both directions. Points of the
frame must be on the surface, and the surface must not be in front of them, where the frame looks through it.

The alignment is that of the tracker: coarse-to-fine point-to-plane ICP with color (see `framework.tracking.alignment`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float64, Frame, SurfaceView
from framework.geometry import exp_se3, nearest_rotation, pose_distance
from framework.interfaces import SubmapSurfaces
from framework.tracking.alignment import NormalEquations, Weights, linearize, model_view, smoothed
from framework.tracking.depth_scale import DepthScale
from framework.tracking.pyramid import PyramidLevel, build_pyramid, model_intensities

LEVELS = 3
ITERATIONS = (6, 8, 12)  # at each level, finest first
FINEST_SIDE = 320  # px, maximum side of the finest level
CONVERGED = 1e-4  # maximum last step of the finest level, m and rad; the limit is four times larger per coarser level
MIN_OVERLAP = 0.1  # minimum fraction of a frame's points on the first view for a second one
MAX_CORRECTION = 0.05  # m and rad, maximum motion by the second alignment, which starts from the result of the first
WEIGHTS = Weights(  # those of the tracker, with a larger distance because loops start from less accurate poses
    max_distance=np.float32(0.2),
    close_distance=np.float32(0.05),
    min_normal_dot=np.float32(0.7),
    geometric_scale=np.float32(4),
    photometric_scale=np.float32(4),
    intensity_noise=np.float32(0.05),
    color_weight=np.float32(0.1),
    depth_weight=np.float32(1),
)


class SubmapMatch(NamedTuple):
    """A frame aligned to hidden submaps."""

    T_world_camera: Float64  # (4, 4) in the world frame of the submaps
    visible: float  # fraction of the frame's points that are on a mapped part of the view
    agreement: float  # fraction of the visible points on the surface
    behind: float  # fraction of the visible points behind the surface
    information: float  # ratio of smallest to mean eigenvalue of the normal matrix without units
    correction: float  # m and rad, motion by the second alignment


@dataclass
class LoopVerification:
    """Verification of the pose of a frame relative to hidden submaps."""

    min_visible: float = 0.3  # minimum fraction of a frame's points that are visible in the submaps, in [0, 1]
    min_agreement: float = 0.8  # minimum fraction of the visible points that agree with the surface, in [0, 1]
    max_occluded: float = 0.05  # maximum fraction of the visible points behind the surface, in [0, 1]
    # minimum ratio of smallest to mean eigenvalue of the dimensionless normal matrix, in [0, 1]
    min_information: float = 5e-3

    def __post_init__(self) -> None:
        check_bounds(
            self, min_visible=(0.0, 1.0), min_agreement=(0.0, 1.0), max_occluded=(0.0, 1.0), min_information=(0.0, 1.0)
        )

    def accepts(self, match: SubmapMatch) -> bool:
        """Return True if all checks pass."""
        return (
            match.visible >= self.min_visible
            and match.agreement >= self.min_agreement
            and match.behind <= self.max_occluded
            and match.information >= self.min_information
            and match.correction <= MAX_CORRECTION
        )


def match_hidden(
    frame: Frame, T_world_guess: Float64, surfaces: SubmapSurfaces, submaps: Collection[int]
) -> SubmapMatch | None:
    """Return the alignment of a frame to hidden submaps, or None if hardly any of them is in view.

    Args:
        frame: The frame.
        T_world_guess: The pose (4, 4) where the alignment starts, in the world frame of the submaps.
        surfaces: The surfaces of the hidden submaps.
        submaps: The numbers of the submaps.
    """
    levels = pyramid(frame)
    if not levels[0].depth.any():
        return None
    first = _align(levels, surfaces.render(levels[0].camera, T_world_guess, submaps), finest=1)
    if first.equations.visible < MIN_OVERLAP * np.count_nonzero(levels[1].depth):
        return None
    T_world_first = first.view.T_world_camera @ first.T_view_camera
    second = _align(levels, surfaces.render(levels[0].camera, T_world_first, submaps, levels[0].depth))
    T_world_camera = T_world_first @ second.T_view_camera
    T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
    equations = second.equations
    visible = max(equations.visible, 1)
    scale = DepthScale.of(levels[-1].depth)
    # as in the tracker: color without lambda, because only the geometric term contains false information from noise
    A = equations.A + (1 / float(WEIGHTS.color_weight) - 1) * equations.A_color
    information = np.linalg.eigvalsh(scale.without_units(A))
    return SubmapMatch(
        T_world_camera,
        visible=equations.visible / np.count_nonzero(levels[0].depth),
        agreement=equations.close / visible,
        behind=equations.behind / visible,
        information=float(information[0] / max(information.mean(), 1e-12)),
        correction=pose_distance(np.eye(4), second.T_view_camera),
    )


def overlaps(
    frame: Frame, T_world_camera: Float64, surfaces: SubmapSurfaces, submaps: Collection[int]
) -> dict[int, float]:
    """Return the fraction of the frame's points that agree with the surface of each hidden submap, by number."""
    level = pyramid(frame)[-1]
    points, close = level.depth > 0, np.maximum(WEIGHTS.close_distance, 3 * level.sensor.sigma(level.depth))
    found = {}
    for number in sorted(submaps):
        mapped = surfaces.render(level.camera, T_world_camera, [number], level.depth).depth
        agreeing = points & (mapped > 0) & (np.abs(mapped - level.depth) < close)
        found[number] = float(np.count_nonzero(agreeing) / np.count_nonzero(points))
    return found


def pyramid(frame: Frame) -> list[PyramidLevel]:
    """Return the image pyramid of a frame, finest level first."""
    scale = 1.0
    while max(frame.camera.shape) * scale > FINEST_SIDE:
        scale /= 2
    return build_pyramid(frame.camera, frame.depth, frame.color, scale, LEVELS, frame.sensor)


class _Alignment(NamedTuple):
    """An alignment to a view."""

    view: SurfaceView
    T_view_camera: Float64  # (4, 4)
    equations: NormalEquations  # at this pose


def _align(levels: list[PyramidLevel], view: SurfaceView, finest: int = 0) -> _Alignment:
    """Return the alignment of a frame to a view, computed coarse to fine up to the given level."""
    model, intensities = model_view(view), model_intensities(view, LEVELS)
    T_view_camera, brightness = np.eye(4), 0.0
    for level in reversed(range(finest, LEVELS)):
        smooth = smoothed(model, level)
        weights = WEIGHTS._replace(  # as in the tracker, larger residuals are allowed at coarse levels
            max_distance=WEIGHTS.max_distance * np.float32(1 + level),
            geometric_scale=WEIGHTS.geometric_scale * np.float32(2**level),
            photometric_scale=WEIGHTS.photometric_scale * np.float32(2**level),
        )
        for _ in range(ITERATIONS[level]):
            equations = linearize(levels[level], smooth, intensities[level], T_view_camera, weights, brightness)
            brightness = equations.brightness
            damping = 1e-6 * max(float(np.trace(equations.A)), 1e-12) * np.eye(6)
            xi = np.asarray(np.linalg.solve(equations.A + damping, -equations.b), np.float64)
            T_view_camera = exp_se3(xi) @ T_view_camera
            if np.abs(xi).max() < CONVERGED * 4**level:
                break
    equations = linearize(levels[finest], smooth, intensities[finest], T_view_camera, weights, brightness)
    return _Alignment(view, T_view_camera, equations)
