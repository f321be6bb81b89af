"""Cluster refinement by rank-order clustering.

This is our interpretation of the "ROC algorithm" in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float32, Frame, Int32, Int64, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.neighborhood_kernels import grouped
from framework.refinement.refine import keep_points


@dataclass
class RankOrder(ClusterRefiner):
    """Selection of the largest rank-order group of each cluster.

    The paper names the alternative "ROC algorithm [12]", but its reference list is not available. We interpret it as
    rank-order clustering (Zhu et al., CVPR 2011), where points belong together if they have the same neighbors. The
    distance is the approximation of Otto et al. ("Clustering Millions of Faces by Identity", PAMI 2018), eqs. 4 and 5.
    O_a(b) is the rank of b among the neighbors of a, nearest first, and f_a(i) is the neighbor with rank i:

        d(a, b) = number of i in 1 .. min(O_a(b), k) for which f_a(i) is not among the k nearest of b (or b itself),
        D(a, b) = (d(a, b) + d(b, a)) / min(O_a(b), O_b(a)).

    Two points are linked if D is at most `threshold` and one point is among the k nearest of the other. Groups are
    connected components, and ties go to the first group in the image. A cluster of at most k points is not changed. In
    large clusters, at most `max_points` evenly distributed points are compared. Every other point joins the group of
    the nearest one.
    """

    neighbors: int = 16  # number k of nearest neighbors, in [2, 254]
    threshold: float = 1.0  # maximum rank-order distance of linked points, >= 0
    max_points: int = 500  # maximum number of points of a cluster that are compared, in [10, 5000]

    def __post_init__(self) -> None:
        # a square table stores ranks as bytes
        check_bounds(self, neighbors=(2, 254), threshold=(0.0, np.inf), max_points=(10, 5000))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        from scipy.spatial import KDTree

        order, firsts = grouped(clusters.cluster, len(clusters))
        kept = np.ones(len(clusters.cluster), np.bool_)
        for k in range(len(clusters)):
            own = order[firsts[k] : firsts[k + 1]]
            if len(own) > 1:
                points = clusters.points_world[own]
                sampled = points[_firsts_of_blocks(clusters.pixels[own], self.max_points)]
                groups = rank_order_groups(sampled, self.neighbors, self.threshold)
                _, nearest = KDTree(sampled).query(points)
                kept[own] = groups[nearest] == np.bincount(groups).argmax()
        return keep_points(clusters, kept)


def _firsts_of_blocks(pixels: Int32, max_points: int) -> Int64:
    """Return the indices of at most `max_points` pixels, the first in each square block of pixels."""
    u, v = (pixels - pixels.min(axis=0)).T
    side = int(np.ceil(np.sqrt(len(pixels) / max_points)))
    while True:
        columns = u.max() // side + 1
        firsts = np.full(columns * (v.max() // side + 1), -1)
        firsts[(v // side * columns + u // side)[::-1]] = np.arange(len(pixels))[::-1]  # the last write is kept
        if np.count_nonzero(firsts >= 0) <= max_points:
            return np.sort(firsts[firsts >= 0])
        side += 1


def rank_order_groups(points: Float32, neighbors: int, threshold: float) -> Int32:
    """Return the rank-order group (P,) of each point.

    Groups are numbered in the order of their first points. See `RankOrder`.

    Args:
        points: The points (P, 3), m.
        neighbors: The number k of nearest neighbors.
        threshold: The maximum rank-order distance of linked points.
    """
    n, k = len(points), neighbors
    if n <= k:  # all points have the same neighbors
        return np.zeros(n, np.int32)
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from sklearn.neighbors import NearestNeighbors

    nearest = NearestNeighbors(n_neighbors=k).fit(points).kneighbors(return_distance=False)
    absent = k + 1
    ranks = np.full((n, n), absent, np.uint8)  # O_a(b)
    np.fill_diagonal(ranks, 0)
    np.put_along_axis(ranks, nearest, np.arange(1, k + 1, dtype=np.uint8), axis=1)

    def unshared(a: Int64, b: Int64) -> Int64:
        """Return d(a, b)."""
        up_to_b = np.arange(k) < ranks[a, b][:, None]
        return np.asarray((up_to_b & (ranks[b[:, None], nearest[a]] == absent)).sum(axis=1))

    a, linked = np.arange(n), np.zeros((n, n), np.uint8)
    for b in nearest.T:
        linked[a, b] = unshared(a, b) + unshared(b, a) <= threshold * np.minimum(ranks[a, b], ranks[b, a])
    return np.asarray(connected_components(csr_array(linked), directed=False)[1], np.int32)
