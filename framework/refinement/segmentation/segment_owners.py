"""Assignment of segments of the depth image to masks.

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

# minimum square root of the second eigenvalue of the scatter of points, m; below it, the camera pose is inaccurate
MIN_SPREAD = 0.02
SAMPLE = 4096  # approximate number of points used to compute the camera pose
TOLERANCE = 1e-3  # maximum distance of a point from its depth reading, m


def owned_segments(
    clusters: PointClusters, frame: Frame, labels: Int32, count: int, min_overlap: float, whole_segments: bool
) -> PointClusters:
    """Return the clusters without points outside their segments.

    A segment belongs to the mask that covers the most of its pixels.

    Args:
        clusters: The clusters.
        frame: The frame.
        labels: The segment (H, W) of each pixel, -1 = none.
        count: The number of segments.
        min_overlap: The minimum fraction of a segment inside the mask that it belongs to.
        whole_segments: True to add all readings of its segments to a cluster, also outside its mask.
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
    """Return the camera pose T_world_camera (4, 4), computed from the points of the clusters.

    The pose is the least-squares rigid motion between the depth readings and the points (Arun et al., 1987). It is None
    if there are too few points or if all points are on one line.

    Raises:
        DataError: If the points are not from the depth readings of this frame.
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
    """Return the world points (P, 3), m, of the depth readings at the given pixels (P, 2), u and v."""
    return np.asarray(transform(T_world_camera, _readings(pixels, frame)), np.float32)


def _readings(pixels: Int32, frame: Frame) -> Float64:
    """Return the depth readings at the given pixels as points (P, 3) in the camera frame, m."""
    camera = frame.camera
    z = frame.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return np.stack([(pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z, z], axis=1)
