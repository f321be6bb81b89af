"""Groups of points that have the same neighbors: rank-order clustering, over scikit-learn's neighbors."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Float32, Int32, Int64, PointClusters
from framework.refinement.neighborhood_kernels import grouped


def in_largest_group(clusters: PointClusters, neighbors: int, threshold: float, max_points: int) -> Bool:
    """(P,) which points are in the largest group of their cluster, of equals the one seen first, or in no cluster.

    Only the first point of each block of s x s px takes part, s the smallest that leaves at most `max_points`; every
    other point goes with the nearest of them.
    """
    from scipy.spatial import KDTree

    order, firsts = grouped(clusters.cluster, len(clusters))
    kept = np.ones(len(clusters.cluster), np.bool_)
    for k in range(len(clusters)):
        own = order[firsts[k] : firsts[k + 1]]
        if len(own) > 1:
            points = clusters.points_world[own]
            sampled = points[_firsts_of_blocks(clusters.pixels[own], max_points)]
            groups = rank_order_groups(sampled, neighbors, threshold)
            _, nearest = KDTree(sampled).query(points)
            kept[own] = groups[nearest] == np.bincount(groups).argmax()
    return kept


def _firsts_of_blocks(pixels: Int32, max_points: int) -> Int64:
    """The first of the pixels (P, 2) in each block, with the smallest blocks that leave at most `max_points`."""
    u, v = (pixels - pixels.min(axis=0)).T
    side = int(np.ceil(np.sqrt(len(pixels) / max_points)))
    while True:
        columns = u.max() // side + 1
        first = np.full(columns * (v.max() // side + 1), -1)
        first[(v // side * columns + u // side)[::-1]] = np.arange(len(pixels))[::-1]  # the last one written stays
        if np.count_nonzero(first >= 0) <= max_points:
            return np.sort(first[first >= 0])
        side += 1


def rank_order_groups(points: Float32, neighbors: int, threshold: float) -> Int32:
    """(P,) the group of each of the points (P, 3), numbered by their first points; see `plugins.refiners.rank_order`.

    Which of equally near points is the nearer one is left to scikit-learn.
    """
    n, k = len(points), neighbors
    if n <= k:  # all have the same neighbors
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
        """d(a, b)."""
        first = np.arange(k) < ranks[a, b][:, None]
        return np.asarray((first & (ranks[b[:, None], nearest[a]] == absent)).sum(axis=1))

    a, linked = np.arange(n), np.zeros((n, n), np.uint8)
    for b in nearest.T:
        linked[a, b] = unshared(a, b) + unshared(b, a) <= threshold * np.minimum(ranks[a, b], ranks[b, a])
    return np.asarray(connected_components(csr_array(linked), directed=False)[1], np.int32)
