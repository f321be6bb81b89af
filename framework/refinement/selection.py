"""What every shrinking refiner does at its end: drop points, and keep everything else as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Bool, PointClusters
from framework.refinement.selection_kernels import compress, part_starts


def keep_points(clusters: PointClusters, kept: Bool) -> PointClusters:
    """The clusters without the points where `kept` (P,) is False.

    A dropped point leaves the arrays. Clusters keep their index, scores and classes, so that cluster k still is
    detection k, also when no point is left of it.
    """
    starts = part_starts(kept)
    points_world = np.empty((starts[-1], 3), np.float32)
    pixels, cluster = np.empty((starts[-1], 2), np.int32), np.empty(starts[-1], np.int32)
    compress(clusters.points_world, clusters.pixels, clusters.cluster, kept, starts, points_world, pixels, cluster)
    return replace(clusters, points_world=points_world, pixels=pixels, cluster=cluster)
