"""Cluster refinement by a flat Gaussian mixture: the paper's step, with components for what surrounds the object."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.initialization import start_labels
from framework.refinement.mixtures.mask_evidence import mask_log_odds
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.selection import keep_points


@dataclass
class GmmEm(ClusterRefiner):
    """Drops the points that a Gaussian mixture of object, background and outliers assigns to the last two.

    Eqs. [1] to [4] of the paper, once for each mask: object components start from the mask's points, background
    components from a ring of pixels around the mask, grouped by place; a uniform component takes outliers. The mask
    stays known after the start: a point deep inside has log-odds of `mask_log_odds` for the object, a point of the ring
    up to as much against it, with a linear ramp between (our choice: without it the Gaussians of object and background
    trade places in one mask of eight). What an earlier refiner knows as `structure` is neither border nor ring.
    Clusters only shrink: a dropped point leaves the arrays, clusters keep their index. Clusters with fewer than
    `min_points` points, or with as few in their ring, are left as they are.
    """

    object_components: int = 3  # from 1; the visible faces of an object, which one Gaussian covers badly
    background_components: int = 6  # from 1; occluders, supporting surface, neighbors, walls
    max_iterations: int = 8  # from 1
    tolerance: float = 1e-3  # nats a point; EM ends when the mean log-likelihood gains less
    std_floor: float = 0.01  # m, least standard deviation of a component along any axis
    outlier_fraction: float = 0.02  # in [0, 1), share of outliers at the start
    min_posterior: float = 0.5  # in (0, 1), a point stays when the object's share of it is larger
    mask_log_odds: float = 4.0  # nats, from 0; 0 = the mask is the start only, as in the paper
    expected_bleed: float = 0.4  # in [0, 1), how far inside of the mask its log-odds are 0, in widths of the ring
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(
            self,
            object_components=(1, 64),
            background_components=(1, 64),
            max_iterations=(1, 1000),
            tolerance=(0.0, np.inf),
            std_floor=(1e-4, 1.0),
            outlier_fraction=(0.0, 0.99),
            min_posterior=(1e-6, 1 - 1e-6),
            mask_log_odds=(0.0, 20.0),
            expected_bleed=(0.0, 0.99),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring)
        sample = around.sampled(self.ring.max_points)
        log_odds = mask_log_odds(sample, self.mask_log_odds, self.expected_bleed)
        mixtures = mixture.fit(
            sample.points_camera,
            sample.starts,
            start_labels(sample, log_odds, self.object_components, self.background_components),
            self.object_components + self.background_components,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            variance_floor=self.std_floor**2,
            outlier_fraction=self.outlier_fraction,
            prior_log_odds=log_odds,
            own_components=self.object_components,
        )
        own, judged = around.own(), around.of_at_least(self.ring.min_points)
        claimed = mixture.likely_members(
            own.points_camera,
            own.starts[:-1],
            own.starts[:-1] + np.where(judged, own.mask_counts, 0),
            mixtures,
            own_components=self.object_components,
            min_posterior=self.min_posterior,
            prior_log_odds=mask_log_odds(own, self.mask_log_odds, self.expected_bleed),
        )
        return keep_points(clusters, around.kept(claimed, judged))
