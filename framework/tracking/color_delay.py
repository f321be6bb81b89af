"""Estimation of the delay between color and depth.

If the camera moves, depth edges coincide with color edges only after they are moved by the camera motion during the
delay. For each compared frame k, the delay d_k has the largest mean color gradient at the moved depth edges.

The error of d_k, as a distance in the image, does not depend on the speed. An inaccurate registration of the cameras
adds a constant offset o in the image. With the mean image motion v_k of the edges and its direction n_k:

    |v_k| d_k = |v_k| d + n_k . o + noise

Robust regression with Tukey's biweight and a normal prior on the offset gives the delay d. Errors of nearby frames are
correlated, so CORRELATED frames count as one. The standard deviation is at least that of a jackknife over blocks of
frames. Slow frames are not compared.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import DelayEstimate, Float32, Float64, Frame
from framework.geometry import back_project, pose_distance, project
from framework.interfaces import SubmapChange
from framework.tracking.color_delay_kernels import find_edges, mean_gradients
from framework.tracking.pyramid import intrinsics

TESTED_DELAYS = np.linspace(-0.1, 0.1, 41)  # s
HISTORY = 7  # number of successive frames with known motion; the frame in the middle is compared
MAX_STEP = 0.2  # s, maximum time between successive frames
WIDTH = 320  # px, width of the compared images
MAX_GRADIENT = 200.0  # Sobel units; stronger gradients are clipped, so that lamps do not dominate
MIN_EDGES, MAX_EDGES = 100, 1500  # minimum and maximum number of edge points of a compared frame
MIN_SPEED = 0.125  # minimum image motion of a compared frame, image widths per s
DENSE_COMPARISONS, LATER_STRIDE = 60, 8  # number of comparisons of successive frames; later, every 8th frame
MIN_COMPARISONS, MAX_COMPARISONS = 16, 512  # minimum and maximum number of recent comparisons for an estimate
PERIOD = 4  # number of comparisons from one estimate to the next
BLOCKS = 8  # number of blocks of the jackknife
MAX_DEVIATION = 0.002  # s, maximum standard deviation of a usable estimate ...
MAX_RELATIVE_DEVIATION = 0.25  # ... or, if larger, the maximum as a fraction of the estimate
OFFSET_DEVIATION = 0.5 / 640  # image widths, standard deviation of the constant offset of registered images
CORRELATED = 8  # number of comparisons with a common error
MIN_NOISE = 0.1 / 640  # image widths, minimum standard deviation of a comparison
CUT_OFF = 4.685  # residual with weight 0 in Tukey's biweight, in standard deviations
ITERATIONS = 10  # number of iterations of the robust regression

UNKNOWN = DelayEstimate(0.0, np.inf, 0)


def is_usable(estimate: DelayEstimate) -> bool:
    """Return True if the estimated delay is accurate enough to register color."""
    return estimate.deviation <= max(MAX_DEVIATION, MAX_RELATIVE_DEVIATION * abs(estimate.seconds))


class _Tracked(NamedTuple):
    frame: Frame
    T_world_camera: Float64


class DelayEstimator:
    """Online estimator of the delay of color relative to depth at equal timestamps.

    The delay is positive if color is captured later.
    """

    def __init__(self) -> None:
        self.estimate = UNKNOWN
        self._recent: deque[_Tracked] = deque(maxlen=HISTORY)
        self._frames = 0  # number of added frames
        self._compared = 0  # number of compared frames
        # delay, s, and mean image motion (x, y), image widths / s
        self._comparisons: deque[tuple[float, float, float]] = deque(maxlen=MAX_COMPARISONS)
        self._strengths = np.zeros(len(TESTED_DELAYS))  # sums of the mean gradients of all compared frames

    def add(self, frame: Frame, T_world_camera: Float64) -> None:
        """Add the next frame with its tracked pose, and update the estimate."""
        if self._recent and not 0 < frame.depth_time - self._recent[-1].frame.depth_time <= MAX_STEP:
            self.interrupt()
        self._recent.append(_Tracked(frame, T_world_camera))
        self._frames += 1
        skipped = len(self._comparisons) >= DENSE_COMPARISONS and self._frames % LATER_STRIDE
        if skipped or len(self._recent) < HISTORY or not self._compare():
            return
        if len(self._comparisons) >= MIN_COMPARISONS and self._compared % PERIOD == 0:
            start = float(TESTED_DELAYS[self._strengths.argmax()])
            self.estimate = regress(np.array(self._comparisons), start)

    def correct(self, change: SubmapChange, submap: int) -> None:
        """Move the poses of the recent frames with the submap of the last frame."""
        for k, (frame, T_world_camera) in enumerate(self._recent):
            self._recent[k] = _Tracked(frame, change.moved(submap, T_world_camera))

    def interrupt(self) -> None:
        """Discard recent frames, because the motion to the next frame is unknown."""
        self._recent.clear()

    def _compare(self) -> bool:
        """Compare color and depth of the middle one of the recent frames, and return True if its delay was found.

        The delay is not found if the frame is slow, has too few edges, or has a delay outside the tested range.
        """
        before, (frame, T_world_camera), after = (self._recent[HISTORY // 2 + k] for k in (-1, 0, 1))
        camera = frame.camera
        seconds = after.frame.depth_time - before.frame.depth_time
        turn = pose_distance(before.T_world_camera, after.T_world_camera) * camera.fx / camera.width
        if turn < MIN_SPEED * seconds:
            return False
        points = edge_points(frame)
        if len(points) < MIN_EDGES:
            return False
        times = np.array([one.frame.depth_time for one in self._recent])
        poses = np.array([one.T_world_camera for one in self._recent])
        at = np.concatenate([frame.color_time + TESTED_DELAYS, [before.frame.depth_time, after.frame.depth_time]])
        moved = np.linalg.inv(poses_at(times, poses, at)) @ T_world_camera  # T_color_depth at each time
        motion = [project(camera, points @ T[:3, :3].T + T[:3, 3]) for T in moved[-2:]]
        velocity = (motion[1] - motion[0]).mean(axis=0) / (seconds * camera.width)
        if np.hypot(*velocity) < MIN_SPEED:
            return False
        gradient, scale = normalized_gradient(frame)
        strengths = np.empty(len(TESTED_DELAYS))
        transforms = np.ascontiguousarray(moved[:-2, :3], np.float32)
        mean_gradients(points, transforms, intrinsics(camera), np.float32(scale), gradient, strengths)
        self._strengths += strengths
        best = int(strengths.argmax())
        if not 0 < best < len(TESTED_DELAYS) - 1:
            return False
        low, high, next_ = strengths[best - 1 : best + 2]
        vertex = (low - next_) / (low - 2 * high + next_) / 2
        delay = TESTED_DELAYS[best] + vertex * (TESTED_DELAYS[1] - TESTED_DELAYS[0])
        self._compared += 1
        self._comparisons.append((float(delay), float(velocity[0]), float(velocity[1])))
        return True


def edge_points(frame: Frame) -> Float32:
    """Return at most MAX_EDGES points (P, 3) on the nearer side of depth edges, camera frame, m."""
    edges = np.empty((frame.depth.size // 8, 3), np.float32)
    edges = edges[: find_edges(frame.depth, edges)]
    edges = edges[:: len(edges) // MAX_EDGES + 1]
    return back_project(frame.camera, np.ascontiguousarray(edges[:, :2]), np.ascontiguousarray(edges[:, 2]))


def normalized_gradient(frame: Frame) -> tuple[Float32, float]:
    """Return the normalized intensity gradient (h, w) of a reduced image, and the reduction factor.

    The gradient magnitude has mean 0 and standard deviation 1.
    """
    scale = min(WIDTH / frame.camera.width, 1.0)
    small = cv2.resize(frame.color, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    gradient = cv2.magnitude(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    gradient = cv2.GaussianBlur(np.minimum(gradient, np.float32(MAX_GRADIENT)), (0, 0), 1.0)
    deviation = max(float(gradient.std()), 1e-6)
    return np.asarray((gradient - gradient.mean()) / np.float32(deviation), np.float32), scale


def poses_at(times: Float64, poses: Float64, at: Float64) -> Float64:
    """Return the interpolated or extrapolated poses (A, 4, 4) at the times `at` (A,), s.

    Args:
        times: The times (P,) of the poses, increasing, s.
        poses: The poses (P, 4, 4).
        at: The times (A,) of the results, s.
    """
    k = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    fractions = (at - times[k]) / (times[k + 1] - times[k])
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    steps = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec()
    found = np.tile(np.eye(4), (len(at), 1, 1))
    found[:, :3, :3] = R[k] @ Rotation.from_rotvec(fractions[:, None] * steps[k]).as_matrix()
    found[:, :3, 3] = t[k] + fractions[:, None] * (t[k + 1] - t[k])
    return found


def regress(comparisons: Float64, start: float) -> DelayEstimate:
    """Return the delay, estimated by robust regression.

    Args:
        comparisons: The delay, s, and the image motion (x, y), image widths / s, of each compared frame (K, 3).
        start: The initial delay, s.
    """
    delays, speeds = comparisons[:, 0], np.hypot(comparisons[:, 1], comparisons[:, 2])
    shifts = speeds * delays  # image widths
    X = np.column_stack([speeds, comparisons[:, 1:] / speeds[:, None]])
    solution = np.array([start, 0.0, 0.0])
    for _ in range(ITERATIONS):
        residuals = shifts - X @ solution
        scale = max(1.4826 * float(np.median(np.abs(residuals))), MIN_NOISE)
        weights = np.maximum(1 - (residuals / (CUT_OFF * scale)) ** 2, 0) ** 2
        variance = CORRELATED * scale**2
        covariance = variance * np.linalg.inv(_information(X, weights, variance))
        solution = covariance @ X.T @ (weights * shifts) / variance
    without = []  # estimated delays, s, each without one of the blocks
    for block in np.array_split(np.arange(len(delays)), BLOCKS):
        rest = weights.copy()
        rest[block] = 0
        without.append(np.linalg.solve(_information(X, rest, variance), X.T @ (rest * shifts))[0])
    deviation = max(float(np.sqrt((BLOCKS - 1) * np.var(without))), float(np.sqrt(covariance[0, 0])))
    return DelayEstimate(float(solution[0]), deviation, len(delays))


def _information(X: Float64, weights: Float64, variance: float) -> Float64:
    """Return the information matrix (3, 3) of the regression, including the prior on the offset."""
    prior = np.array([0.0, 1.0, 1.0]) * variance / OFFSET_DEVIATION**2
    return np.asarray((X * weights[:, None]).T @ X + np.diag(prior))
