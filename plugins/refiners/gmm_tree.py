"""Cluster refinement by a tree of Gaussian mixtures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures.mixture_kernels import EmSettings
from framework.refinement.mixtures.mixture_tree import claimed, fit, object_ratios
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.refine import keep_points


@dataclass
class GmmTree(ClusterRefiner):
    """Removal of surface patches outside the object by hierarchical EM.

    A tree of mixtures (Eckart et al., CVPR 2016) is fitted to the points of each mask and of the ring around it. Its
    nodes are surface patches. The fit ignores the border of the mask, because a wrong assignment at the first level
    could not be corrected later.

    The mask is then used as evidence, as in `gmm_em`. The object fraction of a node is estimated from the evidence of
    its points, with the fraction of its parent as a prior (our choice). A point is kept if the object fractions of its
    nodes and its own evidence give a posterior above `min_posterior`. Outliers at the first level are removed. Clusters
    with too few points in the mask or the ring are not changed.
    """

    levels: int = 2  # number of levels of the tree, in [1, 8]
    children: int = 8  # number of children of a node, in [2, 64]; J of Eckart et al. 2016
    max_iterations: int = 8  # maximum number of EM iterations in a node, in [1, 1000]
    tolerance: float = 1e-3  # minimum increase of the mean log-likelihood per EM iteration, nats per point, >= 0
    std_floor: float = 0.01  # minimum standard deviation of a node along any axis, m, in [0.0001, 1]
    outlier_fraction: float = 0.02  # initial fraction of outliers in a node, in [0, 0.99]
    # minimum fraction of the tree's points in a node, in [0, 0.99]; smaller nodes are dropped
    min_support: float = 1e-4
    min_split_points: int = 32  # minimum number of points of a node to be split, >= 8
    parent_points: float = 4.0  # weight of the parent node's object fraction as a prior, in points, >= 0
    min_posterior: float = 0.5  # minimum posterior probability of the object to keep a point, in (0, 1)
    mask_log_odds: float = 2.0  # prior log-odds of the object far inside the mask, nats, in [0, 20]
    # distance inside the mask border at which the prior log-odds are 0, in ring widths, in [0, 0.99]
    expected_bleed: float = 0.5
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(
            self, levels=(1, 8), children=(2, 64), max_iterations=(1, 1000), tolerance=(0.0, np.inf),
            std_floor=(1e-4, 1.0), outlier_fraction=(0.0, 0.99), min_support=(0.0, 0.99), min_split_points=(8, 10**9),
            parent_points=(0.0, 1e9), min_posterior=(1e-6, 1 - 1e-6), mask_log_odds=(0.0, 20.0),
            expected_bleed=(0.0, 0.99),
        )  # fmt: skip

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring)
        sample = around.sampled(self.ring.max_points)
        tree = fit(
            sample.points_camera, sample.starts,
            EmSettings(self.max_iterations, self.tolerance, self.std_floor**2, self.outlier_fraction),
            levels=self.levels, children=self.children, min_support=self.min_support, min_points=self.min_split_points,
        )  # fmt: skip
        odds = sample.mask_log_odds(self.mask_log_odds, self.expected_bleed)
        ratios = object_ratios(tree, sample, odds, self.parent_points)
        judged = around.of_at_least(self.ring.min_points)
        judged &= np.diff(tree.levels[0].firsts) > 0  # a tree without nodes is not evidence against its mask
        own = around.own()
        own_odds = own.mask_log_odds(self.mask_log_odds, self.expected_bleed)
        return keep_points(clusters, around.kept(claimed(tree, ratios, own, own_odds, self.min_posterior), judged))
