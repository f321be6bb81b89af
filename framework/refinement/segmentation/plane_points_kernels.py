"""Kernels of plane_points.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Int32, Int64, UInt8
from framework.refinement.selection_kernels import PART


@njit(cache=True, nogil=True, parallel=True)
def find_off_planes(
    cluster: Int32, pixels: Int32, on_plane: UInt8, max_own: float, counts: Int64, stays: Bool, structure: Bool
) -> Bool:
    """Returns which points are kept, and takes those on planes from `structure`.

    A pixel is in a cluster once, so its points on a plane are a part of the plane's.
    """
    labels, kept = np.empty(len(cluster), np.uint8), np.empty(len(cluster), np.bool_)
    for part in prange(len(counts)):
        own = slice(part * PART, (part + 1) * PART)
        _count_on_planes(cluster[own], pixels[own], on_plane, labels[own], counts[part])
    _judge(counts, on_plane, max_own, stays)
    for i in prange(len(cluster)):
        kept[i] = stays[cluster[i], labels[i]]
        if kept[i] and cluster[i] >= 0 and labels[i] > 0:
            structure[pixels[i, 1], pixels[i, 0]] = False
    return kept


@njit(cache=True, nogil=True)
def _judge(counts: Int64, on_plane: UInt8, max_own: float, stays: Bool) -> None:
    """Takes from `stays` the points of each cluster, but the last row's, on each plane, but column 0's, that leave."""
    parts, rows, columns = counts.shape
    for label in range(1, columns):
        most = max_own * _count(on_plane.ravel(), label)
        for k in range(rows - 1):
            own = 0
            for part in range(parts):
                own += counts[part, k, label]
            stays[k, label] = own > most


@njit(cache=True, nogil=True)
def _count_on_planes(cluster: Int32, pixels: Int32, on_plane: UInt8, labels: UInt8, counts: Int64) -> None:
    """By runs of points that have cluster and plane in common: a counter raised point by point waits for itself."""
    k, label, count = 0, 0, 0
    for i in range(len(cluster)):
        labels[i] = on_plane[pixels[i, 1], pixels[i, 0]]
        if labels[i] != label or cluster[i] != k:
            counts[k, label] += count
            k, label, count = cluster[i], labels[i], 0
        count += 1
    counts[k, label] += count


@njit(cache=True, nogil=True)
def _count(labels: UInt8, label: int) -> int:
    wanted, count = np.uint8(label), 0
    for first in range(0, len(labels), 128):  # a count of bytes in a byte is the fastest there is
        some = np.uint8(0)
        for found in labels[first : first + 128]:
            some += np.uint8(found == wanted)
        count += int(some)
    return count
