"""Which mask owns which segment of the depth image, and clusters made of what their masks own.

The rule of Voxblox++ (Grinvald et al., RA-L 2019).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Frame, Int32, PointClusters
from framework.refinement.absolute_orientation import camera_pose, points_at
from framework.refinement.segmentation.segment_owners_kernels import find_owners, judged
from framework.refinement.selection import keep_points


def owned_segments(
    clusters: PointClusters, frame: Frame, labels: Int32, count: int, min_overlap: float, whole_segments: bool
) -> PointClusters:
    """The clusters without what their masks caught beside their segments; `labels` (H, W) in [0, `count`), -1 = none.

    A segment is the one mask's that covers most of it, if that is more than `min_overlap` of its pixels. With
    `whole_segments` the clusters get their segments' readings outside of their masks, where the camera's pose is known.
    """
    owners = find_owners(clusters.pixels, clusters.cluster, len(clusters), labels, count, min_overlap)
    kept, missing, missing_owner = judged(clusters.pixels, clusters.cluster, labels, owners)
    refined = keep_points(clusters, kept)
    return _grown(refined, clusters, frame, missing, missing_owner) if whole_segments else refined


def _grown(
    refined: PointClusters, clusters: PointClusters, frame: Frame, missing: Int32, missing_owner: Int32
) -> PointClusters:
    """The refined clusters with the readings at the `missing` pixels, each in its owner's."""
    T_world_camera = camera_pose(clusters, frame) if len(missing) else None
    if T_world_camera is None:
        return refined
    added = points_at(missing, frame, T_world_camera)
    return replace(
        refined,
        points_world=np.concatenate([refined.points_world, added]),
        pixels=np.concatenate([refined.pixels, missing]),
        cluster=np.concatenate([refined.cluster, missing_owner]),
    )
