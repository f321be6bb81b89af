"""Kernels of lloyd_iterations.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Float64, Int32, Int64


@njit(cache=True, nogil=True, parallel=True)
def lloyd_all(points: Float32, starts: Int64, centers: Float64, max_iterations: int, labels: Int32) -> None:
    """Run k-means on each set of points, and update `centers` and `labels` in place."""
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            lloyd(points[starts[k] : starts[k + 1]], centers[k], max_iterations, labels[starts[k] : starts[k + 1]])


@njit(cache=True, nogil=True)
def lloyd(points: Float32, centers: Float64, max_iterations: int, labels: Int32) -> None:
    """Run k-means on one set of points (S, 3), and update `centers` (K, 3) and `labels` (S,) in place."""
    sums = np.zeros((len(centers), 4))
    for _ in range(max_iterations):
        changed = False
        sums[:] = 0.0
        for i in range(len(points)):
            j = nearest(points[i], centers)
            changed |= j != labels[i]
            labels[i] = j
            sums[j, 0] += 1.0
            sums[j, 1] += points[i, 0]
            sums[j, 2] += points[i, 1]
            sums[j, 3] += points[i, 2]
        if not changed:
            return
        for j in range(len(centers)):
            if sums[j, 0] > 0:
                for a in range(3):
                    centers[j, a] = sums[j, a + 1] / sums[j, 0]


@njit(cache=True, nogil=True)
def nearest(point: Float32, centers: Float64) -> int:
    """Return the index of the center (K, 3) nearest to a point (3,)."""
    nearest, least = 0, np.inf
    for j in range(len(centers)):
        x, y, z = point[0] - centers[j, 0], point[1] - centers[j, 1], point[2] - centers[j, 2]
        distance = x * x + y * y + z * z
        if distance < least:
            nearest, least = j, distance
    return nearest


@njit(cache=True, nogil=True, parallel=True)
def nearest_all(points: Float32, begins: Int64, ends: Int64, centers: Float64) -> Int32:
    """Return the index (S,) of the center nearest to each point, -1 = the point is in no set."""
    labels = np.full(len(points), -1, np.int32)
    for k in range(len(begins)):
        for i in prange(begins[k], ends[k]):
            labels[i] = nearest(points[i], centers[k])
    return labels


@njit(cache=True, nogil=True, parallel=True)
def group_depths(points: Float32, starts: Int64, groups: int) -> Float64:
    """Return the means (N, groups, 3), m, of groups of points at different depths."""
    means = np.zeros((len(starts) - 1, groups, 3))
    for k in prange(len(starts) - 1):
        means[k] = depth_groups_of(points[starts[k] : starts[k + 1]], groups)
    return means


@njit(cache=True, nogil=True)
def depth_groups_of(points: Float32, groups: int) -> Float64:
    """Return the means (groups, 3), m, of groups of points of one set at different depths."""
    n, means = len(points), np.zeros((groups, 3))
    if n == 0:
        return means
    order = _by_depth(points)
    for g in range(groups):
        begin, end = g * n // groups, (g + 1) * n // groups
        end = max(end, begin + 1)
        for s in range(begin, end):
            for a in range(3):
                means[g, a] += points[order[s], a] / (end - begin)
    return means


@njit(cache=True, nogil=True)
def _by_depth(points: Float32) -> Int64:
    """Return the indices of the points in order of increasing depth."""
    # stable radix sort, because np.argsort compiles slowly
    n = len(points)
    depths = np.empty(n, np.float32)
    for i in range(n):
        depths[i] = points[i, 2]
    bits, keys = depths.view(np.int32), np.empty(n, np.int64)
    for i in range(n):  # bits of positive numbers have the order of the numbers, bits of negative ones the reverse
        keys[i] = (np.int64(bits[i]) if bits[i] >= 0 else np.int64(bits[i] ^ np.int32(0x7FFFFFFF))) + (1 << 31)
    order, sorted_ = np.arange(n), np.empty(n, np.int64)
    starts = np.empty(257, np.int64)
    for shift in range(0, 32, 8):
        starts[:] = 0
        for i in range(n):
            starts[((keys[i] >> shift) & 255) + 1] += 1
        for byte in range(256):
            starts[byte + 1] += starts[byte]
        for s in range(n):
            byte = (keys[order[s]] >> shift) & 255
            sorted_[starts[byte]] = order[s]
            starts[byte] += 1
        order, sorted_ = sorted_, order
    return order


@njit(cache=True, nogil=True, parallel=True)
def start_all(
    points: Float32, log_odds: Float32, starts: Int64, mask_counts: Int64, object_components: int,
    background_components: int, iterations: int, labels: Int32,
) -> None:  # fmt: skip
    """Set the initial component (S,) of each point.

    See start_labels().
    """
    for k in prange(len(starts) - 1):
        own = slice(starts[k], starts[k + 1])
        _start_one(
            points[own],
            log_odds[own],
            mask_counts[k],
            object_components,
            background_components,
            iterations,
            labels[own],
        )


@njit(cache=True, nogil=True)
def _start_one(
    points: Float32, log_odds: Float32, mask_count: int, object_components: int, background_components: int,
    iterations: int, labels: Int32,
) -> None:  # fmt: skip
    of_ring, in_core = np.empty(len(points), np.bool_), np.empty(len(points), np.bool_)
    for i in range(len(points)):
        of_ring[i] = i >= mask_count
        in_core[i] = i < mask_count and (log_odds[i] >= 0 or background_components == 0)
    _group(points, in_core, object_components, 0, iterations, labels)
    centers = _group(points, of_ring, background_components, object_components, iterations, labels)
    for i in range(mask_count):
        if not in_core[i]:
            labels[i] = object_components + nearest(points[i], centers)


@njit(cache=True, nogil=True)
def _group(points: Float32, chosen: Bool, groups: int, first_label: int, iterations: int, labels: Int32) -> Float64:
    """Group the chosen points by k-means, set their labels, and return the centers (groups, 3), m."""
    own, own_labels, count = np.empty_like(points), np.empty(len(points), np.int32), 0
    for i in range(len(points)):
        if chosen[i]:
            own[count, 0], own[count, 1], own[count, 2] = points[i, 0], points[i, 1], points[i, 2]
            own_labels[count] = -1
            count += 1
    centers: Float64 = depth_groups_of(own[:count], groups)
    lloyd(own[:count], centers, iterations, own_labels[:count])
    count = 0
    for i in range(len(points)):
        if chosen[i]:
            labels[i] = first_label + own_labels[count]
            count += 1
    return centers
