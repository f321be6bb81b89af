"""Cluster refinement by depth: points far in front of or behind the median of a cluster are dropped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from instancemap import ClusterRefiner, Frame, PointClusters, check_bounds, keep_points


@dataclass
class DepthMedian(ClusterRefiner):
    """Selection of the points of each cluster with a depth near the cluster's median.

    A mask that extends beyond an object's outline includes points of the background, at other depths. If these are
    fewer than half of the points, the median is a depth of the object. Clusters keep their index.
    """

    reach: float = 0.3  # maximum difference from the cluster's median depth at depth 0, m, >= 0
    reach_per_depth: float = 0.02  # increase of the maximum difference with depth, m per m, >= 0

    def __post_init__(self) -> None:
        check_bounds(self, reach=(0.0, np.inf), reach_per_depth=(0.0, np.inf))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        u, v = clusters.pixels.T
        depth = frame.depth[v, u]
        kept = np.ones(len(depth), np.bool_)
        for k in range(len(clusters)):
            own = clusters.cluster == k
            if own.any():
                median = np.median(depth[own])
                kept[own] = np.abs(depth[own] - median) <= self.reach + self.reach_per_depth * median
        return keep_points(clusters, kept)
