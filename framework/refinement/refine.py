"""Refinement of the clusters of one frame."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from framework.data import Bool, Frame, PointClusters
from framework.errors import DataError
from framework.geometry import require_pixels_inside
from framework.interfaces import ClusterRefiner
from framework.refinement.refine_kernels import compress, part_starts


def refine(refiner: ClusterRefiner, clusters: PointClusters, frame: Frame) -> PointClusters:
    """Return the refined clusters.

    Clusters from exact masks or from frames without a detector run are returned unchanged.

    Raises:
        DataError: If the refiner does not return PointClusters, or if it returns pixels outside the image.
    """
    if clusters.exact or not clusters.detected:
        return clusters
    refined = refiner.refine(clusters, frame)
    if not isinstance(cast(object, refined), PointClusters):
        raise DataError(f"frame {frame.index}: expected PointClusters from the refiner, got {type(refined).__name__}")
    require_pixels_inside(refined, frame.depth.shape)  # later stages use them as indices
    return refined


def keep_points(clusters: PointClusters, kept: Bool) -> PointClusters:
    """Return the clusters with only the points for which `kept` (P,) is True.

    All clusters remain, even if they have no points, so that cluster k always belongs to detection k.
    """
    starts = part_starts(kept)
    points_world = np.empty((starts[-1], 3), np.float32)
    pixels, cluster = np.empty((starts[-1], 2), np.int32), np.empty(starts[-1], np.int32)
    compress(clusters.points_world, clusters.pixels, clusters.cluster, kept, starts, points_world, pixels, cluster)
    return replace(clusters, points_world=points_world, pixels=pixels, cluster=cluster)
