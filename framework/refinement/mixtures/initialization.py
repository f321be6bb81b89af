"""Where expectation maximization and k-means start: from mask and ring, each cut into groups by place."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures.lloyd_iterations import depth_groups, depth_groups_of, lloyd, nearest
from framework.refinement.neighborhood import Neighborhoods

START_ITERATIONS = 5  # of Lloyd's algorithm, which need not converge for a start


def start_labels(around: Neighborhoods, log_odds: Float32, object_components: int, background_components: int) -> Int32:
    """(S,) the component that each point starts in: the object's come first, then the background's.

    Points of the mask whose `log_odds` (S,) do not speak against the object start in the nearest of the object's
    groups, points of the ring in the nearest of the background's. The border of the mask, as far in as it is expected
    to bleed, starts in the nearest group of the ring.
    """
    labels = np.empty(len(around.points_camera), np.int32)
    _start_all(
        around.points_camera,
        log_odds,
        around.starts,
        around.mask_counts,
        object_components,
        background_components,
        labels,
    )
    return labels


def start_centers(around: Neighborhoods, object_centers: int, background_centers: int) -> Float64:
    """(N, object_centers + background_centers, 3) the means of mask and ring, each cut into equal parts by depth."""
    of_ring = around.of_ring
    mask_starts = np.concatenate([[0], np.cumsum(around.mask_counts)])
    ring_starts = np.concatenate([[0], np.cumsum(around.ring_counts)])
    objects = depth_groups(around.points_camera[~of_ring], mask_starts, object_centers)
    background = depth_groups(around.points_camera[of_ring], ring_starts, background_centers)
    return np.concatenate([objects, background], axis=1)


@njit(cache=True, nogil=True, parallel=True)
def _start_all(
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
