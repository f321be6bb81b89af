"""Where the camera stood that saw a frame's point clusters: what refiners need to add points of their own.

SciPy's align_vectors finds the same rotation, but only warns where the points leave it open.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Float64, Frame, Int32, PointClusters
from framework.errors import DataError
from framework.geometry import nearest_rotation

LEAST_SPREAD = 0.02  # m, root of the second eigenvalue of the scatter; single precision then moves 5 m by under 0.1 mm
SAMPLE = 4096  # points that are looked at, evenly spaced: more change the pose by less than single precision does
TOLERANCE = 1e-3  # m, that a point may lie off the reading that it comes from


def camera_pose(clusters: PointClusters, frame: Frame) -> Float64 | None:
    """T_world_camera (4, 4) under which the readings of `frame` at the clusters' pixels are their points in the world.

    The least-squares rigid motion between the two (Arun, Huang and Blostein, "Least-Squares Fitting of Two 3-D Point
    Sets", PAMI 1987). None where the points leave a rotation open: too few, or all on one line. Raises DataError
    where no motion explains them, because they come from other readings.
    """
    step = max(len(clusters.pixels) // SAMPLE, 1)
    points_world, pixels = clusters.points_world[::step], clusters.pixels[::step]
    sums, scatter, cross = _sums(points_world, pixels, frame.depth, _pinhole(frame))
    count = sums[0]
    if count < 3 or np.sqrt(max(np.linalg.eigvalsh(scatter)[1], 0.0)) < LEAST_SPREAD:
        return None
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = nearest_rotation(cross)
    T_world_camera[:3, 3] = sums[4:7] / count - T_world_camera[:3, :3] @ (sums[1:4] / count)
    farthest = _farthest(points_world, pixels, frame.depth, _pinhole(frame), T_world_camera)
    if farthest > TOLERANCE:
        raise DataError(
            f"frame {frame.index}: the clusters' points lie up to {farthest:.3g} m off the depth readings at their "
            f"pixels, expected at most {TOLERANCE:g} m: they must come from this frame"
        )
    return T_world_camera


def points_at(pixels: Int32, frame: Frame, T_world_camera: Float64) -> Float32:
    """(P, 3) the readings of `frame` at `pixels` (P, 2) (u, v) in the world, in the arithmetic of geometry.lift."""
    camera = frame.camera
    z = frame.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    x, y = (pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return np.asarray(np.stack([x, y, z], axis=1) @ R.T + t, np.float32)


def _pinhole(frame: Frame) -> Float64:
    return np.array([frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy])


@njit(cache=True, nogil=True)
def _set_point(u: int, v: int, depth: Float32, pinhole: Float64, point: Float64) -> None:
    z = float(depth[v, u])
    point[0], point[1], point[2] = (u - pinhole[2]) / pinhole[0] * z, (v - pinhole[3]) / pinhole[1] * z, z


@njit(cache=True, nogil=True)
def _sums(
    points_world: Float32, pixels: Int32, depth: Float32, pinhole: Float64
) -> tuple[Float64, Float64, Float64]:  # fmt: skip
    """(7,) their number and the sums of points in camera and world; (3, 3) scatter in the camera, world x camera."""
    sums, point = np.zeros(7), np.zeros(3)
    for i in range(len(pixels)):
        _set_point(pixels[i, 0], pixels[i, 1], depth, pinhole, point)
        sums[0] += 1
        for a in range(3):
            sums[1 + a] += point[a]
            sums[4 + a] += points_world[i, a]
    scatter, cross = np.zeros((3, 3)), np.zeros((3, 3))
    means = sums / max(sums[0], 1.0)
    for i in range(len(pixels)):
        _set_point(pixels[i, 0], pixels[i, 1], depth, pinhole, point)
        for b in range(3):
            offset = point[b] - means[1 + b]
            for a in range(3):
                scatter[a, b] += (point[a] - means[1 + a]) * offset
                cross[a, b] += (points_world[i, a] - means[4 + a]) * offset
    return sums, scatter, cross


@njit(cache=True, nogil=True)
def _farthest(points_world: Float32, pixels: Int32, depth: Float32, pinhole: Float64, T: Float64) -> float:
    """The largest distance between a point and where the motion takes its reading."""
    largest, point = 0.0, np.zeros(3)
    for i in range(len(pixels)):
        _set_point(pixels[i, 0], pixels[i, 1], depth, pinhole, point)
        squared = 0.0
        for a in range(3):
            moved = T[a, 0] * point[0] + T[a, 1] * point[1] + T[a, 2] * point[2] + T[a, 3]
            squared += (moved - points_world[i, a]) ** 2
        largest = max(largest, squared)
    return float(np.sqrt(largest))
