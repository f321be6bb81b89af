"""Cluster refinement by rank-order clustering: our reading of the "ROC algorithm" that the paper names."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.rank_order_clustering import in_largest_group
from framework.refinement.selection import keep_points


@dataclass
class RankOrder(ClusterRefiner):
    """Keeps of each cluster its largest group under the rank-order distance.

    The paper names an "ROC algorithm" as an alternative to its mixture and cites nothing for it. We read it as
    rank-order clustering (Zhu, Wen and Sun, "A Rank-Order Distance Based Clustering Algorithm for Face Tagging", CVPR
    2011): two points belong together when they have the same neighbors, however far apart these are. The distance is
    the approximate one of Otto, Wang and Jain ("Clustering Millions of Faces by Identity", PAMI 2018), eqs. 4 and 5:
    with O_a(b) the place of b among the neighbors of a, nearest first, and f_a(i) the i-th of them,

        d(a, b) = number of i in 1 .. min(O_a(b), k) for which f_a(i) is not among the k nearest of b (or b itself),
        D(a, b) = (d(a, b) + d(b, a)) / min(O_a(b), O_b(a)).

    Points with D at most `threshold`, one of them among the k nearest of the other, are in one group, and so are those
    that a chain of such pairs connects. With k points or fewer all have the same neighbors and stay together.

    Only the first point of each block of s x s px takes part, s the smallest that leaves at most `max_points`; every
    other point goes with the nearest of them. Of equally large groups the one seen first in the image stays. A dropped
    point leaves the arrays, clusters keep their index.
    """

    neighbors: int = 16  # from 2, k
    threshold: float = 1.0  # from 0
    max_points: int = 500  # from 10, of a cluster that are compared

    def __post_init__(self) -> None:
        check_bounds(
            self,
            neighbors=(2, 254),  # ranks are bytes
            threshold=(0.0, np.inf),
            max_points=(10, 5000),  # their ranks are a square table
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return keep_points(clusters, in_largest_group(clusters, self.neighbors, self.threshold, self.max_points))
