"""Kernels of lloyd_iterations.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Float32, Float64, Int32, Int64


@njit(cache=True, nogil=True, parallel=True)
def lloyd_all(points: Float32, starts: Int64, centers: Float64, max_iterations: int, labels: Int32) -> None:
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            lloyd(points[starts[k] : starts[k + 1]], centers[k], max_iterations, labels[starts[k] : starts[k + 1]])


@njit(cache=True, nogil=True)
def lloyd(points: Float32, centers: Float64, max_iterations: int, labels: Int32) -> None:
    sums = np.zeros((len(centers), 4))
    for _ in range(max_iterations):
        changed = False
        for j in range(len(centers)):
            for a in range(4):
                sums[j, a] = 0.0
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
    nearest, least = 0, np.inf
    for j in range(len(centers)):
        x, y, z = point[0] - centers[j, 0], point[1] - centers[j, 1], point[2] - centers[j, 2]
        distance = x * x + y * y + z * z
        if distance < least:
            nearest, least = j, distance
    return nearest


@njit(cache=True, nogil=True, parallel=True)
def nearest_all(points: Float32, begins: Int64, ends: Int64, centers: Float64) -> Int32:
    labels = np.full(len(points), -1, np.int32)
    for k in range(len(begins)):
        for i in prange(begins[k], ends[k]):
            labels[i] = nearest(points[i], centers[k])
    return labels


@njit(cache=True, nogil=True, parallel=True)
def group_depths(points: Float32, starts: Int64, groups: int) -> Float64:
    means = np.zeros((len(starts) - 1, groups, 3))
    for k in prange(len(starts) - 1):
        means[k] = depth_groups_of(points[starts[k] : starts[k + 1]], groups)
    return means


@njit(cache=True, nogil=True)
def depth_groups_of(points: Float32, groups: int) -> Float64:
    """`depth_groups` of one set, (groups, 3)."""
    n, means = len(points), np.zeros((groups, 3))
    if n == 0:
        return means
    order = _by_depth(points)
    for g in range(groups):
        first, last = g * n // groups, (g + 1) * n // groups
        last = max(last, first + 1)
        for s in range(first, last):
            for a in range(3):
                means[g, a] += points[order[s], a] / (last - first)
    return means


@njit(cache=True, nogil=True)
def _by_depth(points: Float32) -> Int64:
    """The points' numbers, nearest first, of equally near ones the first: a radix sort, byte by byte.

    np.argsort takes a second to compile.
    """
    n = len(points)
    depths = np.empty(n, np.float32)
    for i in range(n):
        depths[i] = points[i, 2]
    bits, keys = depths.view(np.int32), np.empty(n, np.int64)
    for i in range(n):  # bits sort like their number, a negative one's backwards
        keys[i] = (np.int64(bits[i]) if bits[i] >= 0 else np.int64(bits[i] ^ np.int32(0x7FFFFFFF))) + (1 << 31)
    order, sorted_ = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        order[i] = i
    starts = np.empty(257, np.int64)
    for shift in range(0, 32, 8):
        for byte in range(257):
            starts[byte] = 0
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
