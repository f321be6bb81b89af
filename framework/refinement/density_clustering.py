"""Dense pieces of clusters: DBSCAN, as scikit-learn has it."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Float32, Frame, Int32, PointClusters
from framework.refinement.neighborhood_kernels import grouped


def in_densest_piece(
    clusters: PointClusters,
    frame: Frame,
    *,
    eps: float,
    eps_per_depth: float,
    min_points: int,
    stride: int,
    max_points: int,
) -> Bool:
    """(P,) which points are near the largest dense piece of their cluster, or in one without any, or in none.

    The parameters are those of `plugins.refiners.dbscan`.
    """
    order, firsts = grouped(clusters.cluster, len(clusters))
    kept = np.ones(len(clusters.cluster), np.bool_)
    for k in range(len(clusters)):
        own = order[firsts[k] : firsts[k + 1]]
        pixels, points = clusters.pixels[own], clusters.points_world[own]
        sampled, step = _sampled(pixels, stride, max_points)
        if sampled.any():
            u, v = pixels[sampled].T
            reach = eps + eps_per_depth * float(np.median(frame.depth[v, u]))
            kept[own] = _near_largest_piece(points, points[sampled], reach, min_points, (step / stride) ** 2)
    return kept


def _sampled(pixels: Int32, stride: int, max_points: int) -> tuple[Bool, int]:
    """(P,) the pixels in every `step`-th row and column, with the smallest step from `stride` on that leaves so few."""
    for step in range(stride, 1 << 16):
        sampled = (pixels[:, 0] % step == 0) & (pixels[:, 1] % step == 0)
        if np.count_nonzero(sampled) <= max_points:
            break
    return sampled, step


def _near_largest_piece(points: Float32, sampled: Float32, eps: float, min_points: int, weight: float) -> Bool:
    """(P,) which points are within eps of a core point of the largest piece of `sampled` (S, 3); all without one."""
    from scipy.spatial import KDTree
    from sklearn.cluster import DBSCAN

    # a ball tree takes two thirds of the time of a k-d tree on surfaces
    found = DBSCAN(eps=eps, min_samples=min_points, algorithm="ball_tree").fit(
        sampled, sample_weight=np.full(len(sampled), weight)
    )
    core = found.core_sample_indices_
    if len(core) == 0:
        return np.ones(len(points), np.bool_)
    pieces = found.labels_[core]  # numbered as they are met, so that of equals the first is the largest
    distances, _ = KDTree(sampled[core[pieces == np.bincount(pieces).argmax()]]).query(
        points, distance_upper_bound=np.nextafter(eps, np.inf)
    )
    return np.asarray(distances <= eps)
