"""Cluster refinement by depth: what lies far before or behind the middle of a cluster is of something else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from instancemap import ClusterRefiner, Frame, PointClusters, check_bounds, keep_points


@dataclass
class DepthMedian(ClusterRefiner):
    """Keeps of each cluster the points whose depth is near the cluster's median.

    A mask that bleeds over an object's outline takes in what lies behind it, at other depths; as long as that is less
    than half of it, the median is of the object. A dropped point leaves the arrays, clusters keep their index.
    """

    reach: float = 0.3  # m, from 0, to either side: half the depth of an object
    reach_per_depth: float = 0.02  # m per m, from 0: the sensor's noise grows with depth

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
