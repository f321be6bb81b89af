"""Lloyd's k-means for many point sets at the same time.

scikit-learn fits one set a call, and takes a hundred times as long for a frame's (20 masks of redkitchen, one core).
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures.lloyd_iterations_kernels import group_depths, lloyd_all, nearest_all


def cluster(points: Float32, starts: Int64, centers: Float64, max_iterations: int) -> tuple[Int32, Float64]:
    """Labels (S,) and centers (N, K, 3) after Lloyd's iterations on each set `points[starts[k]:starts[k + 1]]`.

    `centers` (N, K, 3) are the start. It ends when no label changes or after `max_iterations`. A center that loses all
    of its points stays where it is; of equally near centers the first is taken.
    """
    labels = np.full(len(points), -1, np.int32)
    centers = centers.copy()
    lloyd_all(points, starts, centers, max_iterations, labels)
    return labels, centers


def nearest_centers(points: Float32, begins: Int64, ends: Int64, centers: Float64) -> Int32:
    """(S,) the nearest of the centers of set k for each of `points[begins[k]:ends[k]]`; -1 outside of the ranges."""
    return np.asarray(nearest_all(points, begins, ends, centers), np.int32)


def depth_groups(points: Float32, starts: Int64, groups: int) -> Float64:
    """(N, groups, 3) means of the points cut into `groups` equally many by depth: a start for `cluster`.

    Depth is what separates an occluder in front, the surface that carries an object and the wall behind. A set with
    fewer points than groups gives repeated centers, an empty one zeros.
    """
    return np.asarray(group_depths(points, starts, groups), np.float64)
