"""K-means for many point sets in parallel, and initialization of expectation maximization.

scikit-learn fits one set per call, which is much slower for the masks of a frame.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures.lloyd_iterations_kernels import group_depths, lloyd_all, nearest_all, start_all
from framework.refinement.neighborhood import Neighborhoods


def cluster(points: Float32, starts: Int64, centers: Float64, max_iterations: int) -> tuple[Int32, Float64]:
    """Run k-means on N sets of points, and return the labels (S,) and the centers (N, K, 3), m.

    A center without points does not move. Ties go to the first center.

    Args:
        points: The points (S, 3) of all sets, m.
        starts: The start (N + 1,) of each set in `points`.
        centers: The initial centers (N, K, 3), m.
        max_iterations: The maximum number of iterations. Iteration also ends if no label changes.
    """
    labels = np.full(len(points), -1, np.int32)
    centers = centers.copy()
    lloyd_all(points, starts, centers, max_iterations, labels)
    return labels, centers


def nearest_centers(points: Float32, begins: Int64, ends: Int64, centers: Float64) -> Int32:
    """Return the index (S,) of the center nearest to each point, -1 = the point is in no set.

    Args:
        points: The points (S, 3), m.
        begins: The start (N,) of each set in `points`.
        ends: The end (N,) of each set in `points`.
        centers: The centers (N, K, 3) of each set, m.
    """
    return np.asarray(nearest_all(points, begins, ends, centers), np.int32)


def depth_groups(points: Float32, starts: Int64, groups: int) -> Float64:
    """Return the means (N, groups, 3), m, of groups of points at different depths.

    The points of each set are divided by depth into groups of equal size. The groups roughly separate an occluder, the
    supporting surface and the wall behind the object. Sets with fewer points than groups have repeated means. The means
    of empty sets are 0.

    Args:
        points: The points (S, 3) in the camera frame, m.
        starts: The start (N + 1,) of each set in `points`.
        groups: The number of groups of each set.
    """
    return np.asarray(group_depths(points, starts, groups), np.float64)


def start_centers(around: Neighborhoods, object_centers: int, background_centers: int) -> Float64:
    """Return the initial centers (N, object_centers + background_centers, 3), m, of k-means.

    The object centers are the depth groups of the mask. The background centers are the depth groups of its ring.
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
    """Return the initial component (S,) of each point for expectation maximization.

    Object components come first, then background components. Lloyd's algorithm groups the points of the ring and,
    separately, the points of the mask that are likely on the object. The other points of the mask get the nearest group
    of the ring.

    Args:
        around: The points of the masks and their rings.
        log_odds: The log-odds (S,) that a point is on the object.
        object_components: The number of object components.
        background_components: The number of background components. If 0, all points of a mask get object components.
        iterations: The maximum number of iterations.
    """
    labels = np.empty(len(around.points_camera), np.int32)
    start_all(
        around.points_camera, log_odds, around.starts, around.mask_counts, object_components, background_components,
        iterations, labels,
    )  # fmt: skip
    return labels
