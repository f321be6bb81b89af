"""Cluster refinement by a tree of Gaussian mixtures: many small patches of surface at the price of a few."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures import mixture_tree
from framework.refinement.mixtures.mask_evidence import mask_log_odds
from framework.refinement.mixtures.tree_evidence import claimed, object_shares
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.selection import keep_points


@dataclass
class GmmTree(ClusterRefiner):
    """Drops the points on patches of surface that lie outside of the object, found by hierarchical EM.

    One tree of mixtures (Eckart et al., CVPR 2016) for each mask, over its points and the ring around it together. A
    tree cannot start from mask and ring as `gmm_em` does: what its first level put on the wrong side no deeper level
    could bring back. So its nodes know nothing of the mask; each is a patch of surface, at deeper levels a smaller and
    flatter one. The mask comes in as evidence: every point has log-odds for the object by its place in mask or ring
    (those of `gmm_em`), and a node belongs to the object by the share that makes its points' evidence likeliest, held
    near its parent's where points are few (our choice). A point stays when the leaves that it comes down to, with its
    own evidence, give the object more than `min_posterior`. Outliers, which a uniform component takes, are not the
    object's; those below a node are by that node's share.

    Clusters only shrink: a dropped point leaves the arrays, clusters keep their index. Clusters with fewer than
    `min_points` points, or with as few in their ring, are left as they are.
    """

    levels: int = 2  # from 1, of a tree
    children: int = 8  # from 2, of a node: the paper's J
    max_iterations: int = 8  # from 1, of EM in a node
    tolerance: float = 1e-3  # nats a point; EM ends when the mean log-likelihood gains less
    std_floor: float = 0.01  # m, least standard deviation of a node along any axis
    outlier_fraction: float = 0.02  # in [0, 1), share of outliers at the start of each node
    min_support: float = 1e-4  # in [0, 1), a node with a smaller share of its tree's points is dropped
    min_node: int = 32  # from 8, points that a node needs to get children
    parent_points: float = 4.0  # from 0, points that the parent's share counts for in its children's
    min_posterior: float = 0.5  # in (0, 1), a point stays when the object's share of it is larger
    mask_log_odds: float = 2.0  # nats, from 0, of a point deep in the mask
    expected_bleed: float = 0.5  # in [0, 1), how far inside of the mask its log-odds are 0, in widths of the ring
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(
            self,
            levels=(1, 8),
            children=(2, 64),
            max_iterations=(1, 1000),
            tolerance=(0.0, np.inf),
            std_floor=(1e-4, 1.0),
            outlier_fraction=(0.0, 0.99),
            min_support=(0.0, 0.99),
            min_node=(8, 10**9),
            parent_points=(0.0, 1e9),
            min_posterior=(1e-6, 1 - 1e-6),
            mask_log_odds=(0.0, 20.0),
            expected_bleed=(0.0, 0.99),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring)
        sample = around.sampled(self.ring.max_points)
        tree = mixture_tree.fit(
            sample.points_camera,
            sample.starts,
            levels=self.levels,
            children=self.children,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            variance_floor=self.std_floor**2,
            outlier_fraction=self.outlier_fraction,
            min_support=self.min_support,
            min_points=self.min_node,
        )
        odds = mask_log_odds(sample, self.mask_log_odds, self.expected_bleed)
        shares = object_shares(tree, sample, odds, self.parent_points)
        judged = around.of_at_least(self.ring.min_points)
        judged &= np.diff(tree.levels[0].firsts) > 0  # nothing is known against a mask whose tree has no node
        own = around.own()
        own_odds = mask_log_odds(own, self.mask_log_odds, self.expected_bleed)
        return keep_points(clusters, around.kept(claimed(tree, shares, own, own_odds, self.min_posterior), judged))
