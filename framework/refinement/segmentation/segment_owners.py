"""Which mask owns which segment of the depth image, and clusters made of what their masks own.

The rule of Voxblox++ (Grinvald et al., RA-L 2019).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from framework.data import Bool, Frame, Int32, PointClusters
from framework.refinement.absolute_orientation import camera_pose, points_at
from framework.refinement.selection import keep_points


def owned_segments(
    clusters: PointClusters, frame: Frame, labels: Int32, count: int, min_overlap: float, whole_segments: bool
) -> PointClusters:
    """The clusters without what their masks caught beside their segments; `labels` (H, W) in [0, `count`), -1 = none.

    A segment is the one mask's that covers most of it, if that is more than `min_overlap` of its pixels. With
    `whole_segments` the clusters get their segments' readings outside of their masks, where the camera's pose is known.
    """
    owners = _owners(clusters.pixels, clusters.cluster, len(clusters), labels, count, min_overlap)
    kept, missing, missing_owner = _judged(clusters.pixels, clusters.cluster, labels, owners)
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


@njit(cache=True, nogil=True)
def _owners(pixels: Int32, cluster: Int32, clusters: int, labels: Int32, count: int, min_overlap: float) -> Int32:
    """(count,) the cluster with the most pixels in each segment, the first of equals; -1 = none has enough of them."""
    sizes, covered = np.zeros(count, np.int64), np.zeros((count, clusters), np.int64)
    for label in labels.ravel():
        if label >= 0:
            sizes[label] += 1
    for i in range(len(cluster)):
        label = labels[pixels[i, 1], pixels[i, 0]]
        if label >= 0 and cluster[i] >= 0:
            covered[label, cluster[i]] += 1
    owners = np.full(count, -1, np.int32)
    for s in range(count):
        best = np.argmax(covered[s])
        if covered[s, best] > min_overlap * sizes[s]:
            owners[s] = best
    return owners


@njit(cache=True, nogil=True)
def _judged(pixels: Int32, cluster: Int32, labels: Int32, owners: Int32) -> tuple[Bool, Int32, Int32]:
    """(P,) the points that stay; (A, 2) pixels of owned segments that their owner lacks, and (A,) the owner."""
    height, width = labels.shape
    kept, there = np.ones(len(cluster), np.bool_), np.zeros(labels.shape, np.bool_)
    for i in range(len(cluster)):
        u, v = pixels[i, 0], pixels[i, 1]
        if cluster[i] >= 0:
            kept[i] = labels[v, u] >= 0 and owners[labels[v, u]] == cluster[i]
            there[v, u] |= kept[i]
    count = 0
    for v in range(height):
        for u in range(width):
            there[v, u] |= labels[v, u] < 0 or owners[labels[v, u]] < 0
            count += not there[v, u]
    missing, owner = np.empty((count, 2), np.int32), np.empty(count, np.int32)
    count = 0
    for v in range(height):
        for u in range(width):
            if not there[v, u]:
                missing[count, 0], missing[count, 1] = u, v
                owner[count] = owners[labels[v, u]]
                count += 1
    return kept, missing, owner
