"""Self-calibration of depth: the distortion of the sensor with which the views of a tracked camera agree.

A fixed distortion bends the surface in each view, so that the surfaces of views from different directions disagree. The
poses of the views and the distortion are estimated together, as in SLAC (Zhou and Koltun, "Simultaneous Localization
and Calibration: Self-Calibration of Consumer Depth Cameras", CVPR 2014): Gauss-Newton minimizes the distances between
the surfaces of pairs of views, together with the roughness of the distortion. Only the distortion is used, because the
poses would slide along walls.

The distances hardly depend on the mean of d, which is set to zero.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Float64, Frame, Int32, Pose
from framework.geometry import exp_se3, sampled_camera
from framework.interfaces import DepthCalibrator
from framework.pose_graph.depth_calibration_kernels import linearize_pairs
from framework.sensors.depth_distortion import NODES, DepthDistortion

VIEWS = 60  # maximum number of views
MIN_VIEWS = 20  # minimum number of views for a calibration
PAIRS_PER_VIEW = 10  # maximum mean number of pairs per view
PAIR_DISTANCE = 1.6  # m, maximum distance between the cameras of a pair
PAIR_COSINE = 0.6  # minimum cosine of the angle between the viewing directions of a pair
MIN_RESIDUALS = 100  # minimum number of residuals of a pair

SIDE = 160  # px, longer side of the depth image of a view
STRIDE = 2  # px, step between the compared points of a view
VALID = 0.99  # minimum fraction of readings around a point
DEPTHS = (0.3, 4.5)  # m, range of the points
MAX_SLOPE = 0.1  # maximum depth difference between the two neighbors of a point, fraction of the depth

NOISE = (0.003, 0.0016)  # m and 1/m, standard deviation 3 mm + 1.6 mm z^2 of the distance between two surfaces
MAX_DISTANCE = 0.06  # m, maximum distance between two surfaces at small depths
MIN_COSINE = 0.85  # minimum cosine of the angle between the normals of two surfaces
ROUGHNESS = 100.0  # weight of the difference of two neighboring nodes, relative to the number of residuals per node
SIZE = 10.0  # weight of a node, relative to the number of residuals per node
MEAN = 1e4  # weight of the sum of all nodes, relative to the number of residuals per node
ITERATIONS = 2
POSE_ITERATIONS = 2  # of the poses alone

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The surface in a frame."""

    T_world_view: Float64  # (4, 4) tracked camera pose
    camera: Camera  # of the smoothed depth image
    depth: Float32  # (h, w) m, smoothed, 0 = no point
    normals: Float32  # (h, w, 3) unit normals in the camera frame

    @classmethod
    def of(cls, frame: Frame, T_world_camera: Float64) -> CalibrationView:
        """Return the surface in a frame captured at T_world_camera (4, 4)."""
        step = max(1, round(max(frame.camera.shape) / SIDE))
        readings = [(frame.depth > 0).astype(np.float32), frame.depth]
        valid, total = (
            cv2.GaussianBlur(image, (0, 0), step / 2)[step // 2 :: step, step // 2 :: step] for image in readings
        )
        depth = np.where(valid >= VALID, total / np.maximum(valid, VALID), 0)
        camera = sampled_camera(frame.camera, step)
        normals, usable = _normals(camera, depth)
        return cls(T_world_camera, camera, np.where(usable, depth, 0).astype(np.float32), normals)

    def corrected(self, nodes: Float64) -> CalibrationView:
        """Return the view with corrected depth."""
        return replace(self, depth=DepthDistortion(nodes, self.camera.shape).corrected(self.depth))


@dataclass
class DepthCalibration(DepthCalibrator):
    """Self-calibration of depth with views at equal intervals.

    The distortion of each half of the views is tested on the other half. It is used if it reduces the distances there.
    """

    # number of frames at the start that calibrate depth before the run, in [0, 100000]; 0 = off
    calibration_frames: int = 300
    # minimum relative decrease of the mean squared surface distance in views not used for the fit, in [0, 1]
    min_distance_decrease: float = 0.02

    def __post_init__(self) -> None:
        check_bounds(self, calibration_frames=(0, 100000), min_distance_decrease=(0.0, 1.0))
        self._views: list[CalibrationView] = []
        self._shape = (0, 0)  # height and width of the frames
        self._tracked = 0  # number of tracked frames

    def frames(self, available: int) -> int:
        used = min(available, self.calibration_frames)
        return used if used > (MIN_VIEWS - 1) * self._interval else 0

    @property
    def _interval(self) -> int:
        """Number of frames between two views."""
        return -(-self.calibration_frames // VIEWS)

    def add(self, frame: Frame, pose: Pose) -> None:
        """Add a tracked frame. Frames of another camera than that of the first one are omitted."""
        self._tracked += 1
        if (self._tracked - 1) % self._interval:
            return
        view = CalibrationView.of(frame, pose.T_world_camera)
        if not self._views or view.camera == self._views[0].camera:
            self._shape = frame.camera.shape
            self._views.append(view)

    def distortion(self) -> DepthDistortion | None:
        """Return the distortion, or None if there are too few views or if it does not reduce distances.

        The views are discarded.
        """
        views, self._views, self._tracked = self._views, [], 0
        if len(views) < MIN_VIEWS:
            log.info("depth is not corrected: expected at least %d views, got %d", MIN_VIEWS, len(views))
            return None
        with threadpool_limits(1, "blas"):  # the last digits depend on the number of threads
            gain = validated_gain(views)
            nodes = estimated(views) if gain >= self.min_distance_decrease else None
        if nodes is None:
            log.info("depth is not corrected: the mean squared distance in other views decreases by %.1f%%", 100 * gain)
            return None
        found = DepthDistortion(nodes, self._shape)
        log.info(
            "depth is corrected by %.0f mm (RMS) at 2 m: the mean squared distance in other views decreases by %.0f%%",
            4e3 * found.corrections.std(), 100 * gain,
        )  # fmt: skip
        return found


def validated_gain(views: Sequence[CalibrationView]) -> float:
    """Return the decrease of the mean squared distance in views by the distortion of the others, fraction.

    It is 0 if no views overlap.
    """
    halves = views[: len(views) // 2], views[len(views) // 2 :]
    nodes = [estimated(half) for half in halves]
    before = sum(mean_squared_distance(half, np.zeros(NODES)) for half in halves)
    after = sum(mean_squared_distance(half, other) for half, other in zip(halves, reversed(nodes), strict=True))
    return 1 - after / before if before > 0 else 0.0


def estimated(views: Sequence[CalibrationView]) -> Float64:
    """Return the nodes (R, C) of the distortion, 1/m, with which views agree."""
    equations = _Equations(views)
    roughness = _roughness(NODES)
    nodes = np.zeros(NODES)
    n = nodes.size
    for _ in range(ITERATIONS):
        A, b = equations.linearize(nodes)
        prior = equations.count / n * (ROUGHNESS * roughness + SIZE * np.eye(n) + MEAN)
        A[-n:, -n:] += prior
        b[-n:] += prior @ nodes.ravel()
        x = np.linalg.solve(A, -b)
        equations.move(x[:-n])
        nodes += x[-n:].reshape(NODES)
    return nodes


def mean_squared_distance(views: Sequence[CalibrationView], nodes: Float64) -> float:
    """Return the weighted mean squared distance between the surfaces of views with corrected depth and aligned poses.

    Args:
        views: The views.
        nodes: The corrections (R, C), 1/m.
    """
    equations = _Equations([view.corrected(nodes) for view in views])
    none = np.zeros(NODES)
    for _ in range(POSE_ITERATIONS):
        A, b = equations.linearize(none)
        poses = slice(0, -nodes.size)
        equations.move(np.linalg.solve(A[poses, poses], -b[poses]))
    equations.linearize(none)
    return equations.squared / max(equations.count, 1.0)


class _Equations:
    """The normal equations of the poses of views and of the nodes."""

    def __init__(self, views: Sequence[CalibrationView]) -> None:
        self.T_world_view = np.stack([view.T_world_view for view in views])
        self.depths = np.stack([view.depth for view in views])
        self.normals = np.stack([view.normals for view in views])
        self.camera = views[0].camera
        self.pairs = _overlapping(self.T_world_view)
        self.count = 0.0  # number of residuals
        self.squared = 0.0  # weighted sum of squared residuals

    def linearize(self, nodes: Float64) -> tuple[Float64, Float64]:
        """Return A (6 V + R C, 6 V + R C) and b of the step x with A x = -b; the first view is fixed."""
        p, n, c = len(self.pairs), nodes.size, self.camera
        A_poses, A_cross, A_nodes = np.zeros((p, 12, 12)), np.zeros((p, 12, n)), np.zeros((p, n, n))
        b_poses, b_nodes, errors = np.zeros((p, 12)), np.zeros((p, n)), np.zeros((p, 2))
        linearize_pairs(
            self.pairs, self.depths, self.normals, self.T_world_view, (c.fx, c.fy, c.cx, c.cy), STRIDE,
            nodes.ravel(), nodes.shape[1], NOISE, MAX_DISTANCE, MIN_COSINE,
            A_poses, b_poses, A_nodes, b_nodes, A_cross, errors,
        )  # fmt: skip
        used = errors[:, 0] >= MIN_RESIDUALS
        self.count, self.squared = errors[used].sum(axis=0)
        size = 6 * len(self.T_world_view)
        A, b = np.zeros((size + n, size + n)), np.zeros(size + n)
        rows = (6 * self.pairs[used, :, None] + np.arange(6)).reshape(-1, 12)
        np.add.at(A, (rows[:, :, None], rows[:, None, :]), A_poses[used])
        np.add.at(A[:, size:], rows, A_cross[used])
        A[size:, :size] = A[:size, size:].T
        A[size:, size:] = A_nodes[used].sum(axis=0)
        np.add.at(b, rows, b_poses[used])
        b[size:] = b_nodes[used].sum(axis=0)
        diagonal = np.einsum("ii->i", A)
        diagonal[:6] += 1e9 + diagonal.max(initial=0.0)  # fixed
        diagonal += 1e-3  # for views without pairs
        return A, b

    def move(self, xi: NDArray[np.floating]) -> None:
        """Move the views by twists (6 V,)."""
        twists = np.asarray(xi, np.float64).reshape(-1, 6)
        moved = [T @ exp_se3(twist) for T, twist in zip(self.T_world_view, twists, strict=True)]
        self.T_world_view = np.stack(moved)


def _overlapping(T_world_view: Float64) -> Int32:
    """Return pairs (P, 2) of views (V, 4, 4) that probably overlap, at most PAIRS_PER_VIEW per view on average."""
    positions, directions = T_world_view[:, :3, 3], T_world_view[:, :3, 2]
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    near = (distances < PAIR_DISTANCE) & (directions @ directions.T > PAIR_COSINE)
    np.fill_diagonal(near, False)
    pairs = np.argwhere(near).astype(np.int32)
    return pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), PAIRS_PER_VIEW * len(T_world_view))).astype(np.int64)]


def _normals(camera: Camera, depth: Float64) -> tuple[Float32, Bool]:
    """Return the normals (h, w, 3) of a depth image, and where they are reliable (h, w)."""
    v, u = np.indices(depth.shape)
    points = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(depth.shape)], -1)
    points *= depth[..., None]
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    inner = np.cross(down, right)
    lengths = np.linalg.norm(inner, axis=-1)
    normals, usable = np.zeros((*depth.shape, 3), np.float32), np.zeros(depth.shape, np.bool_)
    normals[1:-1, 1:-1] = inner / np.maximum(lengths, 1e-12)[..., None]
    neighbors = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    center = depth[1:-1, 1:-1]
    slopes = np.maximum(np.abs(right[..., 2]), np.abs(down[..., 2]))
    usable[1:-1, 1:-1] = (
        (neighbors > 0).all(axis=0) & (center > DEPTHS[0]) & (center < DEPTHS[1]) & (lengths > 0)
        & (slopes <= MAX_SLOPE * center)
    )  # fmt: skip
    return normals, usable


def _roughness(shape: tuple[int, int]) -> Float64:
    """Return the matrix L (R C, R C) with d^T L d = the sum of the squared differences of neighboring nodes d."""
    numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    neighbors = [(numbers[:, :-1], numbers[:, 1:]), (numbers[:-1], numbers[1:])]
    first, second = (np.concatenate([pair[k].ravel() for pair in neighbors]) for k in (0, 1))
    differences = np.zeros((len(first), numbers.size))
    differences[np.arange(len(first)), first] = 1
    differences[np.arange(len(first)), second] = -1
    return np.asarray(differences.T @ differences, np.float64)
