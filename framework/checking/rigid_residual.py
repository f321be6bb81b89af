"""Residual of a rigid motion between the points of two frames.

The points of a static scene in two frames differ by a rigid motion, unless the intrinsics or the depth are wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from framework.checking.matched_pairs import MIN_POINTS, MatchedPair
from framework.data import Camera, Float64

MIN_MOTION = 0.04  # fraction of the image width; pairs with less motion fit any camera
MIN_PAIRS = 4  # minimum number of compared pairs
MIN_BETTER = 0.75  # minimum fraction of pairs with a smaller residual
INLIERS = 0.7  # fraction of the points that determine the rigid motion
ROUNDS = 3  # of the estimation of the rigid motion

Reading = Callable[[Camera, Float64, Float64], Float64]
"""Function of a camera, pixels (P, 2) and depth values (P,): the points (P, 3)."""


class Residuals(NamedTuple):
    """Residuals of several readings of the frames, relative to the depth."""

    medians: Float64  # (R,) over all pairs
    ratios: Float64  # (R,) geometric means of the ratios to the first reading; infinite if few pairs have less


def residuals_of(pairs: Sequence[MatchedPair], readings: Sequence[Reading]) -> Residuals | None:
    """Return the residuals of several readings (R,) of the frames, or None with too few pairs."""
    found = [_of_pair(pair, readings) for pair in pairs if pair.motion > MIN_MOTION * pair.first.camera.width]
    values = np.array([one for one in found if one is not None])
    if len(values) < MIN_PAIRS:
        return None
    ratios = values / values[:, :1]
    is_better = (ratios < 1).mean(axis=0) >= MIN_BETTER
    return Residuals(np.median(values, axis=0), np.where(is_better, np.exp(np.log(ratios).mean(axis=0)), np.inf))


def along_z(camera: Camera, pixels: Float64, values: Float64) -> Float64:
    """Return the points (P, 3) for depth values (P,) along z at pixels (P, 2)."""
    return np.asarray(rays(camera, pixels) * values[:, None])


def rays(camera: Camera, pixels: Float64) -> Float64:
    """Return the points (P, 3) at depth 1."""
    return np.column_stack([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))])


def _of_pair(pair: MatchedPair, readings: Sequence[Reading]) -> list[float] | None:
    """Return the residual of each reading, or None with too few depth readings in the second frame."""
    u, v = np.rint(pair.pixels_second).astype(int).T
    height, width = pair.second.depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = np.where(inside, pair.second.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], 0.0)
    known = depth > 0
    if known.sum() < MIN_POINTS:
        return None
    pixels_first, pixels_second = (
        pixels[known].astype(np.float64) for pixels in (pair.pixels_first, pair.pixels_second)
    )
    first, second = pair.points_first[known, 2].astype(np.float64), depth[known].astype(np.float64)
    return [
        _residual(read(pair.first.camera, pixels_first, first), read(pair.second.camera, pixels_second, second))
        for read in readings
    ]


def _residual(first: Float64, second: Float64) -> float:
    """Return the median distance of two sets of points (P, 3) after a rigid motion, relative to the median depth."""
    error = np.zeros(len(first))
    for _ in range(ROUNDS):  # the best points of the last round
        used = error <= np.quantile(error, INLIERS)
        a, b = first[used].mean(axis=0), second[used].mean(axis=0)
        U, _, Vt = np.linalg.svd((second[used] - b).T @ (first[used] - a))  # Kabsch 1976
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        error = np.linalg.norm((first - a) @ R.T + b - second, axis=1)
    return max(float(np.median(error) / np.median(second[:, 2])), 1e-9)
