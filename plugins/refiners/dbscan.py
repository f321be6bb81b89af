"""Cluster refinement by density (DBSCAN)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Float32, Frame, Int32, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.neighborhood_kernels import grouped
from framework.refinement.refine import keep_points


@dataclass
class Dbscan(ClusterRefiner):
    """Selection of the largest dense component of each cluster.

    The refiner runs the DBSCAN of scikit-learn (Ester et al., KDD 1996). The radius increases with the median depth of
    the cluster. The refiner keeps the component with the most core points, and all points within the radius of these
    core points. Ties go to the first component in the image. A cluster without core points is not changed.

    Only the pixels of every `stride`-th row and column are searched for core points. If more than `max_points` of them
    are in a cluster, the stride is increased, and the points get a larger weight.
    """

    eps: float = 0.04  # neighborhood radius at depth 0, m, >= 0.001
    eps_per_depth: float = 0.01  # increase of the radius with depth, m per m, >= 0
    min_points: int = 10  # minimum number of neighbors of a core point, including itself, >= 1
    stride: int = 2  # step between the pixels that are searched for core points, px, in [1, 64]; 1 = all pixels
    # maximum number of points of a cluster that are searched for core points, >= 100; limits memory
    max_points: int = 20000

    def __post_init__(self) -> None:
        check_bounds(
            self, eps=(1e-3, np.inf), eps_per_depth=(0.0, np.inf), min_points=(1, 10**9), stride=(1, 64),
            max_points=(100, 10**9),
        )  # fmt: skip

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        order, firsts = grouped(clusters.cluster, len(clusters))
        kept = np.ones(len(clusters.cluster), np.bool_)
        for k in range(len(clusters)):
            own = order[firsts[k] : firsts[k + 1]]
            pixels, points = clusters.pixels[own], clusters.points_world[own]
            sampled, step = self._sampled(pixels)
            if sampled.any():
                u, v = pixels[sampled].T
                eps = self.eps + self.eps_per_depth * float(np.median(frame.depth[v, u]))
                kept[own] = self._near_largest_piece(points, points[sampled], eps, (step / self.stride) ** 2)
        return keep_points(clusters, kept)

    def _sampled(self, pixels: Int32) -> tuple[Bool, int]:
        """Return a Boolean array (P,), True for the pixels to search for core points, and the sampling step, px."""
        for step in range(self.stride, 1 << 16):  # smallest step with at most max_points pixels
            sampled = (pixels[:, 0] % step == 0) & (pixels[:, 1] % step == 0)
            if np.count_nonzero(sampled) <= self.max_points:
                break
        return sampled, step

    def _near_largest_piece(self, points: Float32, sampled: Float32, eps: float, weight: float) -> Bool:
        """Return a Boolean array (P,), True for the points near the core points of the largest component.

        If there are no core points, all entries are True.

        Args:
            points: The points (P, 3), m.
            sampled: The points (S, 3) that are searched for core points, m.
            eps: The radius, m.
            weight: The weight of each sampled point.
        """
        from scipy.spatial import KDTree
        from sklearn.cluster import DBSCAN

        # on surfaces, a ball tree is faster than a k-d tree
        clustering = DBSCAN(eps=eps, min_samples=self.min_points, algorithm="ball_tree")
        found = clustering.fit(sampled, sample_weight=np.full(len(sampled), weight))
        core = found.core_sample_indices_
        if len(core) == 0:
            return np.ones(len(points), np.bool_)
        pieces = found.labels_[core]  # numbered in the order of their first points, so that ties go to the first
        largest = sampled[core[pieces == np.bincount(pieces).argmax()]]
        distances, _ = KDTree(largest).query(points, distance_upper_bound=np.nextafter(eps, np.inf))
        return np.asarray(distances <= eps)
