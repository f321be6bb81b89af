"""Cluster refinement by rank-order clustering: our reading of the "ROC algorithm" that the paper names."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Float64, Frame, Int32, Int64, PointClusters, UInt8
from framework.interfaces import ClusterRefiner
from framework.parameters import check_bounds
from framework.refinement.neighborhood import grouped
from framework.refinement.selection import keep_points
from framework.refinement.union_find import root

ABSENT = 255  # rank of a point that is not among the nearest


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
            neighbors=(2, ABSENT - 1),
            threshold=(0.0, np.inf),
            max_points=(10, 5000),  # their ranks are a square table
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if clusters.exact:
            return clusters
        order, firsts = grouped(clusters.cluster, len(clusters))
        kept = np.ones(len(clusters.cluster), np.bool_)
        _keep_largest(
            clusters.points_world, clusters.pixels, order, firsts, self.neighbors, self.threshold, self.max_points, kept
        )
        return keep_points(clusters, kept)


@njit(cache=True, nogil=True, parallel=True)
def _keep_largest(
    points: Float32, pixels: Int32, order: Int64, firsts: Int64, neighbors: int, threshold: float, max_points: int,
    kept: Bool,
) -> None:  # fmt: skip
    for k in prange(len(firsts) - 1):
        members = order[firsts[k] : firsts[k + 1]]
        if len(members) > 1:
            sampled = _sampled(pixels, members, max_points)
            groups = rank_order_groups(points[sampled], neighbors, threshold)
            largest = np.argmax(np.bincount(groups))
            axis = _widest_axis(points[sampled])
            names, swept = _sweep(points[sampled], axis)
            for i in members:
                kept[i] = groups[names[_nearest(points[i], axis, swept, names)]] == largest


@njit(cache=True, nogil=True)
def _sampled(pixels: Int32, members: Int64, max_points: int) -> Int64:
    """The first member in each block of pixels, with the smallest blocks that leave at most `max_points`."""
    u0, v0, u1, v1 = pixels[members[0], 0], pixels[members[0], 1], 0, 0
    for i in members:
        u0, v0 = min(u0, pixels[i, 0]), min(v0, pixels[i, 1])
        u1, v1 = max(u1, pixels[i, 0]), max(v1, pixels[i, 1])
    chosen = np.empty(len(members), np.int64)
    side = int(np.ceil(np.sqrt(len(members) / max_points)))
    while True:
        taken = np.zeros(((v1 - v0) // side + 1, (u1 - u0) // side + 1), np.bool_)
        n = 0
        for i in members:
            row, column = (pixels[i, 1] - v0) // side, (pixels[i, 0] - u0) // side
            if not taken[row, column]:
                taken[row, column] = True
                chosen[n] = i
                n += 1
        if n <= max_points:
            return chosen[:n]
        side += 1


@njit(cache=True, nogil=True)
def rank_order_groups(points: Float32, neighbors: int, threshold: float) -> Int32:
    """(P,) the group of each of the points (P, 3), named after its first point."""
    nearest = nearest_neighbors(points, neighbors)
    ranks = _ranks(nearest)
    parents = np.arange(len(points)).astype(np.int32)
    for a in range(len(points)):
        for i in range(nearest.shape[1]):
            b = nearest[a, i]
            if a < b or ranks[b, a] == ABSENT:  # each pair once
                r, s = root(parents, a), root(parents, b)
                if r != s and _distance(nearest, ranks, a, b) <= threshold:
                    parents[max(r, s)] = min(r, s)
    for a in range(len(points)):
        parents[a] = root(parents, a)
    return parents


@njit(cache=True, nogil=True)
def _distance(nearest: Int32, ranks: UInt8, a: int, b: int) -> float:
    """D(a, b). A rank beyond the k-th is never the smaller one: one of the two is among the k nearest of the other."""
    shared_rank = min(ranks[a, b], ranks[b, a])
    return float((_unshared(nearest, ranks, a, b) + _unshared(nearest, ranks, b, a)) / shared_rank)


@njit(cache=True, nogil=True)
def _unshared(nearest: Int32, ranks: UInt8, a: int, b: int) -> int:
    """d(a, b)."""
    count = 0
    for i in range(min(ranks[a, b], nearest.shape[1])):
        count += ranks[b, nearest[a, i]] == ABSENT
    return count


@njit(cache=True, nogil=True)
def _ranks(nearest: Int32) -> UInt8:
    """(P, P) O_a(b), 0 on the diagonal, ABSENT beyond the k-th."""
    n = len(nearest)
    ranks = np.full((n, n), ABSENT, np.uint8)
    for a in range(n):
        ranks[a, a] = 0
        for i in range(nearest.shape[1]):
            ranks[a, nearest[a, i]] = i + 1
    return ranks


@njit(cache=True, nogil=True)
def nearest_neighbors(points: Float32, neighbors: int) -> Int32:
    """(P, min(`neighbors`, P - 1)) of each point the nearest others, nearest first; of equally near the first."""
    n = len(points)
    k = min(neighbors, n - 1)
    names, swept = _sweep(points, _widest_axis(points))
    x, y, z = swept
    nearest, distances = np.empty((n, k), np.int32), np.empty(k)
    for s in range(n):
        distances[:] = np.inf
        found = nearest[names[s]]
        found[:] = n
        left, right = s - 1, s + 1
        while k > 0 and (left >= 0 or right < n):
            step_left = x[s] - x[left] if left >= 0 else np.inf
            step_right = x[right] - x[s] if right < n else np.inf
            if min(step_left, step_right) ** 2 > distances[k - 1]:
                break
            if step_left <= step_right:
                t, left = left, left - 1
            else:
                t, right = right, right + 1
            distance = (x[s] - x[t]) ** 2 + (y[s] - y[t]) ** 2 + (z[s] - z[t]) ** 2
            if distance <= distances[k - 1]:
                _insert(distance, names[t], distances, found)
    return nearest


@njit(cache=True, nogil=True)
def _insert(distance: float, index: int, distances: Float64, found: Int32) -> None:
    """Into the list sorted by distance, then by index; what falls off its end is forgotten."""
    i = len(distances) - 1
    if distance > distances[i] or (distance == distances[i] and index > found[i]):
        return
    while i > 0 and (distance < distances[i - 1] or (distance == distances[i - 1] and index < found[i - 1])):
        distances[i], found[i] = distances[i - 1], found[i - 1]
        i -= 1
    distances[i], found[i] = distance, index


@njit(cache=True, nogil=True)
def _widest_axis(points: Float32) -> int:
    """The axis on which the points spread most: there a sweep meets the fewest."""
    axis, widest = 0, np.float32(-1.0)
    for a in range(3):
        extent = points[:, a].max() - points[:, a].min()
        if extent > widest:
            axis, widest = a, extent
    return axis


@njit(cache=True, nogil=True)
def _sweep(points: Float32, axis: int) -> tuple[Int64, Float64]:
    """The points' indices in the order of that axis, and (3, P) their coordinates in this order, the axis first."""
    names = np.argsort(points[:, axis], kind="mergesort")
    swept = np.empty((3, len(points)))
    for a in range(3):
        for s in range(len(points)):
            swept[a, s] = points[names[s], (axis + a) % 3]
    return names, swept


@njit(cache=True, nogil=True)
def _nearest(point: Float32, axis: int, swept: Float64, names: Int64) -> int:
    """The place in the sweep of the nearest point; of equally near ones that of the smallest name."""
    n = swept.shape[1]
    x, y, z = swept
    px, py, pz = np.float64(point[axis]), np.float64(point[(axis + 1) % 3]), np.float64(point[(axis + 2) % 3])
    start = np.searchsorted(x, px)
    best, least = -1, np.inf
    for t in range(start, n):
        if (x[t] - px) ** 2 > least:
            break
        distance = (x[t] - px) ** 2 + (y[t] - py) ** 2 + (z[t] - pz) ** 2
        if distance < least or (distance == least and names[t] < names[best]):
            best, least = t, distance
    for t in range(start - 1, -1, -1):
        if (x[t] - px) ** 2 > least:
            break
        distance = (x[t] - px) ** 2 + (y[t] - py) ** 2 + (z[t] - pz) ** 2
        if distance < least or (distance == least and names[t] < names[best]):
            best, least = t, distance
    return best
