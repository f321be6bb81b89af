"""Lloyd's k-means for many point sets in parallel, and initialization of k-means and expectation maximization.

scikit-learn fits one set per call, which takes much longer for the masks of a frame.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures.lloyd_iterations_kernels import group_depths, lloyd_all, nearest_all, start_all
from framework.refinement.neighborhood import Neighborhoods


def cluster(points: Float32, starts: Int64, centers: Float64, max_iterations: int) -> tuple[Int32, Float64]:
    """Return the labels (S,) and centers (N, K, 3), m, of k-means on N sets of points with K centers each.

    `points[starts[k]:starts[k + 1]]`, m, is set k; there are S points in total. `centers` (N, K, 3), m, are the initial
    centers. Iteration ends when no label changes, or after `max_iterations`. A center without points stays in place.
    Ties go to the first center.
    """
    labels = np.full(len(points), -1, np.int32)
    centers = centers.copy()
    lloyd_all(points, starts, centers, max_iterations, labels)
    return labels, centers


def nearest_centers(points: Float32, begins: Int64, ends: Int64, centers: Float64) -> Int32:
    """Return the index (S,) in [0, K) of the center nearest to each point (S, 3), m; -1 outside the ranges.

    `points[begins[k]:ends[k]]` is set k, with its own `centers[k]` (K, 3), m.
    """
    return np.asarray(nearest_all(points, begins, ends, centers), np.int32)


def depth_groups(points: Float32, starts: Int64, groups: int) -> Float64:
    """Return the means (N, groups, 3), m, of `groups` groups of points in each of N sets, to initialize `cluster`.

    Set k is `points[starts[k]:starts[k + 1]]`, m, camera frame. Its points are divided by depth, the third coordinate,
    into groups of equal size. Depth separates an occluder, the supporting surface and the wall behind the object. For a
    set with fewer points than groups, centers are repeated. For an empty set, they are 0.
    """
    return np.asarray(group_depths(points, starts, groups), np.float64)


def start_centers(around: Neighborhoods, object_centers: int, background_centers: int) -> Float64:
    """Return the initial centers (N, object_centers + background_centers, 3), m, of k-means for N masks.

    The first are the `depth_groups` of the mask, and the others are those of its ring.
    """
    of_ring = around.of_ring
    mask_starts = np.concatenate([[0], np.cumsum(around.mask_counts)])
    ring_starts = np.concatenate([[0], np.cumsum(around.ring_counts)])
    objects = depth_groups(around.points_camera[~of_ring], mask_starts, object_centers)
    background = depth_groups(around.points_camera[of_ring], ring_starts, background_centers)
    return np.concatenate([objects, background], axis=1)


def start_labels(
    around: Neighborhoods, log_odds: Float32, object_components: int, background_components: int, iterations: int
) -> Int32:
    """Return the initial component (S,) of each point for EM: object components first, then background components.

    Lloyd's algorithm groups the ring's points and, separately, the mask's points with `log_odds` (S,) of at least 0. It
    starts from groups of equal size by depth and runs for at most `iterations` iterations. The mask's other points get
    the nearest group of the ring, or an object component if there are no background components.
    """
    labels = np.empty(len(around.points_camera), np.int32)
    start_all(
        around.points_camera, log_odds, around.starts, around.mask_counts, object_components, background_components,
        iterations, labels,
    )  # fmt: skip
    return labels
