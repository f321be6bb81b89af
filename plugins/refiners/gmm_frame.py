"""Cluster refinement by one Gaussian mixture over all masks of a frame.

This is our first interpretation of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Frame, PointClusters
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures.frame_tree import Initialization, grow
from framework.refinement.mixtures.frame_tree_kernels import keep_best_cluster
from framework.refinement.mixtures.mixture_kernels import EmSettings
from framework.refinement.neighborhood import members
from framework.refinement.neighborhood_kernels import grouped
from framework.refinement.refine import keep_points


class ForeignPoints(Enum):
    """Treatment of points whose most probable Gaussian belongs to another mask."""

    MOVE = "moved to the cluster of that mask"
    DROP = "removed"
    STAY = "kept in their cluster"


@dataclass
class GmmFrame(ClusterRefiner):
    """Assignment of each point to the most probable mask of the frame by hierarchical EM.

    Eqs. (1) to (4) of docs/method.md are applied to the points of all masks (section 3.2.2 of the paper). A pixel in
    several masks belongs to the mask with the highest score. There is no background, and the masks only initialize the
    mixture. Therefore, a point leaves its cluster only if it fits another cluster better. The paper does not specify
    the hierarchy. The levels, the number of children (Eckart et al., CVPR 2016) and the initialization are our choice.
    """

    levels: int = 2  # number of levels of hierarchical EM, in [1, 8]; 1 = flat mixture; 2 is our choice
    # number of children of a node: 2, 4 or 8; 8 is our interpretation of section 3.2.2
    children: int = 8
    # number of level-1 Gaussians per mask, in [1, 64]; section 3.2.2 has one group for each of K classes; 1 per mask is
    # our choice
    gaussians_per_mask: int = 1
    initialization: Initialization = Initialization.MASKS  # initial groups of level 1
    # treatment of points whose most probable Gaussian belongs to another mask: MOVE to that mask (our interpretation of
    # section 3.2.2), DROP or STAY
    foreign_points: ForeignPoints = ForeignPoints.MOVE
    max_iterations: int = 10  # maximum number of EM iterations in a node, in [1, 1000]; our choice
    # minimum increase of the mean log-likelihood per EM iteration, nats per point, >= 0; our choice
    tolerance: float = 1e-3
    std_floor: float = 0.005  # minimum standard deviation of a Gaussian along any axis, m, in [0.0001, 1]; our choice
    # minimum fraction of the frame's points in a Gaussian, in [0, 0.99]; smaller Gaussians are dropped; our choice
    min_support: float = 1e-4
    # minimum number of points of a refined cluster, >= 1; smaller clusters are dropped; our choice
    min_points: int = 30
    # maximum number of points of a frame for the fit, >= 100; all points are assigned; our choice, for speed
    max_points: int = 20_000

    def __post_init__(self) -> None:
        check_bounds(
            self, levels=(1, 8), gaussians_per_mask=(1, 64), max_iterations=(1, 1000), tolerance=(0.0, np.inf),
            std_floor=(1e-4, 1.0), min_support=(0.0, 0.99), min_points=(1, 10**9), max_points=(100, 10**9),
        )  # fmt: skip
        if self.children not in (2, 4, 8):
            raise ConfigError(f"refiner.children: expected 2, 4 or 8, got {self.children}; set refiner.children=8")

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        single = keep_points(clusters, best_of_pixels(clusters, frame.depth.shape))
        order, _ = members(single)
        points, masks = np.ascontiguousarray(single.points_world[order]), single.cluster[order]
        if not len(points):
            return single
        nth = -(-len(points) // self.max_points)
        tree = grow(
            np.ascontiguousarray(points[::nth]), masks[::nth], len(clusters),
            EmSettings(self.max_iterations, self.tolerance, self.std_floor**2, outlier_fraction=0.0),
            levels=self.levels, children=self.children, gaussians_per_mask=self.gaussians_per_mask,
            initialization=self.initialization, min_support=self.min_support,
        )  # fmt: skip
        assigned = masks if self.foreign_points is ForeignPoints.STAY else tree.masks_of(points)
        if self.foreign_points is ForeignPoints.DROP:
            assigned = np.where(assigned == masks, masks, np.int32(-1))
        sizes = np.bincount(assigned[assigned >= 0], minlength=len(clusters))
        too_small = np.append(sizes < self.min_points, False)  # False for -1
        assigned = np.where(too_small[assigned], np.int32(-1), assigned)
        kept, _ = grouped(assigned, len(clusters))
        pixels = single.pixels[order]
        return replace(clusters, points_world=points[kept], pixels=pixels[kept], cluster=assigned[kept])


def best_of_pixels(clusters: PointClusters, shape: tuple[int, int]) -> Bool:
    """Return a Boolean array (P,), True for the points of the cluster with the highest score at their pixel.

    Ties go to the first cluster.

    Args:
        clusters: The clusters.
        shape: The height and width of the frame.
    """
    rank = np.empty(len(clusters), np.int32)
    rank[np.argsort(-clusters.scores, kind="stable")] = np.arange(len(clusters), dtype=np.int32)
    kept = np.empty(len(clusters.cluster), np.bool_)
    keep_best_cluster(clusters.pixels, clusters.cluster, rank, np.full(shape, -1, np.int32), kept)
    return kept
