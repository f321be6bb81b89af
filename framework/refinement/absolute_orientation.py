"""Where the camera stood that saw a frame's point clusters: what refiners need to add points of their own.

SciPy's align_vectors finds the same rotation, but only warns where the points leave it open.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Float64, Frame, Int32, PointClusters
from framework.errors import DataError
from framework.geometry import nearest_rotation, transform

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
    points_world = clusters.points_world[::step].astype(np.float64)
    points_camera = _readings(clusters.pixels[::step], frame)
    if len(points_camera) < 3:
        return None
    offsets = points_camera - points_camera.mean(axis=0)
    if np.sqrt(max(np.linalg.eigvalsh(offsets.T @ offsets)[1], 0.0)) < LEAST_SPREAD:
        return None
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = nearest_rotation((points_world - points_world.mean(axis=0)).T @ offsets)
    T_world_camera[:3, 3] = points_world.mean(axis=0) - T_world_camera[:3, :3] @ points_camera.mean(axis=0)
    farthest = np.linalg.norm(transform(T_world_camera, points_camera) - points_world, axis=1).max()
    if farthest > TOLERANCE:
        raise DataError(
            f"frame {frame.index}: the clusters' points lie up to {farthest:.3g} m off the depth readings at their "
            f"pixels, expected at most {TOLERANCE:g} m: they must come from this frame"
        )
    return T_world_camera


def points_at(pixels: Int32, frame: Frame, T_world_camera: Float64) -> Float32:
    """(P, 3) the readings of `frame` at `pixels` (P, 2) (u, v) in the world, in the arithmetic of geometry.lift."""
    return np.asarray(transform(T_world_camera, _readings(pixels, frame)), np.float32)


def _readings(pixels: Int32, frame: Frame) -> Float64:
    """(P, 3) m, in the camera."""
    camera = frame.camera
    z = frame.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return np.stack([(pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z, z], axis=1)
