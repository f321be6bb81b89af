"""Detection of depth images with other values than depth along z.

Some simulators store the distance to the camera center, and stereo cameras the disparity. Under a wrong reading, the
points of two frames differ by more than a rigid motion. The check compares the residuals of both readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MIN_POINTS, MatchedPair
from framework.data import Camera, Float64

MIN_MOTION = 0.04  # fraction of the image width; pairs with less motion fit any reading
MIN_PAIRS = 4  # minimum number of compared pairs
INLIERS = 0.7  # fraction of the points that determine the rigid motion
ROUNDS = 3  # of the estimation of the rigid motion
# maximum ratio of the residuals with another reading and with depth along z; valid recordings have at least 2.5, and
# recordings with another kind of depth at most 0.5
MAX_RATIO = 0.65
MIN_BETTER = 0.75  # minimum fraction of pairs with a smaller residual


class DepthKind(Enum):
    """Kind of the values in depth images."""

    ALONG_Z = "depth along z"
    ALONG_RAY = "distances to the camera center; divide each value by sqrt(1 + ((u - cx) / fx)^2 + ((v - cy) / fy)^2)"
    INVERSE = "inverse depth or disparities, which increase toward the camera; convert them to depth in mm"


def check_depth_kind(pairs: Sequence[MatchedPair]) -> Finding | None:
    """Return an error if depth images contain another kind of values than depth along z, or None."""
    found = [_residuals(pair) for pair in pairs if pair.motion > MIN_MOTION * pair.first.camera.width]
    residuals = np.array([one for one in found if one is not None]).reshape(-1, len(DepthKind))
    if len(residuals) < MIN_PAIRS:
        return None
    ratios = residuals[:, 1:] / residuals[:, :1]
    means, better = np.exp(np.log(ratios).mean(axis=0)), (ratios < 1).mean(axis=0)
    best = int(means.argmin())
    if means[best] > MAX_RATIO or better[best] < MIN_BETTER:
        return None
    kind = list(DepthKind)[1 + best]
    text = (
        f"expected {DepthKind.ALONG_Z.value}, got {kind.value} (residual of a rigid motion between frames: "
        f"{np.median(residuals[:, 0]):.1%} of the depth, and {np.median(residuals[:, 1 + best]):.1%} after conversion)"
    )
    return Finding(Verdict.ERROR, "depth", text)


def _residuals(pair: MatchedPair) -> list[float] | None:
    """Return the relative residual of a rigid motion for each kind of depth, or None with too few readings."""
    u, v = np.rint(pair.pixels_second).astype(int).T
    height, width = pair.second.depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = np.where(inside, pair.second.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
    known = depth > 0
    if known.sum() < MIN_POINTS:
        return None
    first, second = (
        (pair.first.camera, pair.pixels_first[known], pair.points_first[known, 2].astype(np.float64)),
        (pair.second.camera, pair.pixels_second[known], depth[known].astype(np.float64)),
    )
    return [_residual(_points(kind, *first), _points(kind, *second)) for kind in DepthKind]


def _points(kind: DepthKind, camera: Camera, pixels: Float64, values: Float64) -> Float64:
    """Return the points (P, 3) for depth values (P,) of a kind."""
    rays = np.column_stack([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))])
    match kind:
        case DepthKind.ALONG_RAY:
            values = values / np.linalg.norm(rays, axis=1)
        case DepthKind.INVERSE:
            values = 1 / values
    return np.asarray(rays * values[:, None])


def _residual(first: Float64, second: Float64) -> float:
    """Return the median distance of two sets of points (P, 3) after a rigid motion, relative to the median depth."""
    error = np.zeros(len(first))
    for _ in range(ROUNDS):  # the best points of the last round
        used = error <= np.quantile(error, INLIERS)
        a, b = first[used].mean(axis=0), second[used].mean(axis=0)
        U, _, Vt = np.linalg.svd((second[used] - b).T @ (first[used] - a))  # Kabsch 1976
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        error = np.linalg.norm((first - a) @ R.T + b - second, axis=1)
    return float(np.median(error) / np.median(second[:, 2]))
