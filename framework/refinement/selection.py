"""What every shrinking refiner does at its end: drop points, and keep everything else as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from framework.data import Bool, Float32, Int32, PointClusters


def keep_points(clusters: PointClusters, kept: Bool) -> PointClusters:
    """The clusters without the points where `kept` (P,) is False.

    A dropped point leaves the arrays. Clusters keep their index, scores and classes, so that cluster k still is
    detection k, also when no point is left of it.
    """
    points_world, pixels, cluster = _compressed(clusters.points_world, clusters.pixels, clusters.cluster, kept)
    return replace(clusters, points_world=points_world, pixels=pixels, cluster=cluster)


@njit(cache=True, nogil=True)
def _compressed(points: Float32, pixels: Int32, cluster: Int32, kept: Bool) -> tuple[Float32, Int32, Int32]:
    """The kept rows; five times faster than three times boolean indexing."""
    count = kept.sum()
    kept_points = np.empty((count, 3), np.float32)
    kept_pixels = np.empty((count, 2), np.int32)
    kept_cluster = np.empty(count, np.int32)
    k = 0
    for i in range(len(kept)):
        if kept[i]:
            for a in range(3):
                kept_points[k, a] = points[i, a]
            kept_pixels[k, 0], kept_pixels[k, 1] = pixels[i, 0], pixels[i, 1]
            kept_cluster[k] = cluster[i]
            k += 1
    return kept_points, kept_pixels, kept_cluster
