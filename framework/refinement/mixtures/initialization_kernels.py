"""Kernels of initialization.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures.lloyd_iterations_kernels import depth_groups_of, lloyd, nearest

START_ITERATIONS = 5  # of Lloyd's algorithm, which need not converge for a start


@njit(cache=True, nogil=True, parallel=True)
def start_all(
    points: Float32, log_odds: Float32, starts: Int64, mask_counts: Int64, object_components: int,
    background_components: int, labels: Int32,
) -> None:  # fmt: skip
    for k in prange(len(starts) - 1):
        own = slice(starts[k], starts[k + 1])
        _start_one(points[own], log_odds[own], mask_counts[k], object_components, background_components, labels[own])


@njit(cache=True, nogil=True)
def _start_one(
    points: Float32, log_odds: Float32, mask_count: int, object_components: int, background_components: int,
    labels: Int32,
) -> None:  # fmt: skip
    of_ring, in_core = np.empty(len(points), np.bool_), np.empty(len(points), np.bool_)
    for i in range(len(points)):
        of_ring[i] = i >= mask_count
        in_core[i] = i < mask_count and log_odds[i] >= 0
    _group(points, in_core, object_components, 0, labels)
    centers = _group(points, of_ring, background_components, object_components, labels)
    for i in range(mask_count):
        if not in_core[i]:
            labels[i] = object_components + nearest(points[i], centers)


@njit(cache=True, nogil=True)
def _group(points: Float32, chosen: Bool, groups: int, first_label: int, labels: Int32) -> Float64:
    """Sets the labels of the chosen points; their groups' centers."""
    own, own_labels, count = np.empty_like(points), np.empty(len(points), np.int32), 0
    for i in range(len(points)):
        if chosen[i]:
            own[count, 0], own[count, 1], own[count, 2] = points[i, 0], points[i, 1], points[i, 2]
            own_labels[count] = -1
            count += 1
    centers: Float64 = depth_groups_of(own[:count], groups)
    lloyd(own[:count], centers, START_ITERATIONS, own_labels[:count])
    count = 0
    for i in range(len(points)):
        if chosen[i]:
            labels[i] = first_label + own_labels[count]
            count += 1
    return centers
