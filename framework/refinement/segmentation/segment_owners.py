"""Owner mask of each segment of the depth image, and clusters of the owned segments.

The assignment rule follows Voxblox++ (Grinvald et al., RA-L 2019).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Float32, Float64, Frame, Int32, PointClusters
from framework.errors import DataError
from framework.geometry import nearest_rotation, transform
from framework.refinement.refine import keep_points
from framework.refinement.segmentation.segment_owners_kernels import find_owners, judged

# minimum square root of the scatter's second eigenvalue, m; single precision then shifts points at 5 m by under 0.1 mm
MIN_SPREAD = 0.02
SAMPLE = 4096  # number of evenly spaced points; more points change the pose by less than single precision
TOLERANCE = 1e-3  # maximum distance of a point from its depth reading, m


def owned_segments(
    clusters: PointClusters, frame: Frame, labels: Int32, count: int, min_overlap: float, whole_segments: bool
) -> PointClusters:
    """Return the clusters without points outside their segments.

    `labels`: the segment (H, W) of each pixel in [0, `count`), -1 = none. A segment belongs to the mask that covers the
    most of its pixels, if these are more than a fraction `min_overlap` of the segment. With `whole_segments`, the
    readings of a cluster's segments outside its mask are added to the cluster, if the points determine the camera pose.
    """
    owners = find_owners(clusters.pixels, clusters.cluster, len(clusters), labels, count, min_overlap)
    kept, missing, missing_owner = judged(clusters.pixels, clusters.cluster, labels, owners)
    refined = keep_points(clusters, kept)
    T_world_camera = camera_pose(clusters, frame) if whole_segments and len(missing) else None
    if T_world_camera is None:
        return refined
    added = points_at(missing, frame, T_world_camera)
    return replace(
        refined,
        points_world=np.concatenate([refined.points_world, added]),
        pixels=np.concatenate([refined.pixels, missing]),
        cluster=np.concatenate([refined.cluster, missing_owner]),
    )


def camera_pose(clusters: PointClusters, frame: Frame) -> Float64 | None:
    """Return the T_world_camera (4, 4) that maps the depth readings at the clusters' pixels to the clusters' points.

    The pose is the least-squares rigid motion (Arun, Huang and Blostein, "Least-Squares Fitting of Two 3-D Point Sets",
    PAMI 1987). Returns None if there are too few points or if all points are on one line; SciPy's align_vectors would
    only warn. Raises DataError if the points are not from the readings of this frame.
    """
    step = max(len(clusters.pixels) // SAMPLE, 1)
    points_world = clusters.points_world[::step].astype(np.float64)
    points_camera = _readings(clusters.pixels[::step], frame)
    if len(points_camera) < 3:
        return None
    offsets = points_camera - points_camera.mean(axis=0)
    if np.sqrt(max(np.linalg.eigvalsh(offsets.T @ offsets)[1], 0.0)) < MIN_SPREAD:
        return None
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = nearest_rotation((points_world - points_world.mean(axis=0)).T @ offsets)
    T_world_camera[:3, 3] = points_world.mean(axis=0) - T_world_camera[:3, :3] @ points_camera.mean(axis=0)
    farthest = np.linalg.norm(transform(T_world_camera, points_camera) - points_world, axis=1).max()
    if farthest > TOLERANCE:
        raise DataError(
            f"frame {frame.index}: expected cluster points within {TOLERANCE:g} m of the frame's depth "
            f"readings, got {farthest:.3g} m; refine clusters of this frame only"
        )
    return T_world_camera


def points_at(pixels: Int32, frame: Frame, T_world_camera: Float64) -> Float32:
    """Return the world-frame points (P, 3), m, of `frame` at `pixels` (P, 2), u and v, as computed by `lift`."""
    return np.asarray(transform(T_world_camera, _readings(pixels, frame)), np.float32)


def _readings(pixels: Int32, frame: Frame) -> Float64:
    """Return the depth readings at `pixels` (P, 2), u and v, as camera-frame points (P, 3), m."""
    camera = frame.camera
    z = frame.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return np.stack([(pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z, z], axis=1)
