"""Cluster refinement by one Gaussian mixture for each mask and its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.lloyd_iterations import start_labels
from framework.refinement.mixtures.mixture_kernels import EmSettings
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.refine import keep_points


@dataclass
class GmmEm(ClusterRefiner):
    """Removal of background and outliers by a Gaussian mixture for each mask.

    The mixture is fitted by eqs. (1) to (4) of docs/method.md. Object components are initialized by groups of points in
    the mask. Background components are initialized by groups of points in a ring around the mask. A uniform component
    can represent outliers.

    The mask is also evidence for the object (our choice). Otherwise, object and background can swap. The log-odds
    decrease linearly from `mask_log_odds` inside the mask to -`mask_log_odds` in the ring. Pixels of known structure,
    found by an earlier refiner, are not part of the ring. Clusters with too few points in the mask or the ring are not
    changed. Without background components, only outliers are removed.
    """

    object_components: int = 3  # number of Gaussians of the object, in [1, 64]; about one per visible face
    background_components: int = 6  # number of Gaussians of the background, in [0, 64]; 0 = no background model
    # number of k-means iterations for the initialization, in [1, 1000]; starts from groups of equal size, ordered by
    # depth
    start_iterations: int = 5
    max_iterations: int = 8  # maximum number of EM iterations, in [1, 1000]
    tolerance: float = 1e-3  # minimum increase of the mean log-likelihood per EM iteration, nats per point, >= 0
    std_floor: float = 0.01  # minimum standard deviation of a Gaussian along any axis, m, in [0.0001, 1]
    outlier_fraction: float = 0.0  # initial fraction of outliers, in [0, 0.99]; 0 = no uniform component for outliers
    min_posterior: float = 0.5  # minimum posterior probability of the object to keep a point, in (0, 1)
    # prior log-odds of the object far inside the mask, nats, in [0, 20]; 0 = the mask only initializes the mixture
    mask_log_odds: float = 4.0
    # distance inside the mask border at which the prior log-odds are 0, in ring widths, in [0, 0.99]
    expected_bleed: float = 0.4
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(
            self, object_components=(1, 64), background_components=(0, 64), start_iterations=(1, 1000),
            max_iterations=(1, 1000), tolerance=(0.0, np.inf), std_floor=(1e-4, 1.0), outlier_fraction=(0.0, 0.99),
            min_posterior=(1e-6, 1 - 1e-6), mask_log_odds=(0.0, 20.0), expected_bleed=(0.0, 0.99),
        )  # fmt: skip

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring if self.background_components else self.ring.without_ring())
        sample = around.sampled(self.ring.max_points)
        log_odds = sample.mask_log_odds(self.mask_log_odds, self.expected_bleed)
        labels = start_labels(
            sample, log_odds, self.object_components, self.background_components, self.start_iterations
        )
        mixtures = mixture.fit(
            sample.points_camera, sample.starts, labels, self.object_components + self.background_components,
            EmSettings(self.max_iterations, self.tolerance, self.std_floor**2, self.outlier_fraction),
            prior_log_odds=log_odds, own_components=self.object_components,
        )  # fmt: skip
        own, judged = around.own(), around.of_at_least(self.ring.min_points)
        claimed = mixture.likely_members(
            own.points_camera, own.starts[:-1], own.starts[:-1] + np.where(judged, own.mask_counts, 0), mixtures,
            own_components=self.object_components, min_posterior=self.min_posterior,
            prior_log_odds=own.mask_log_odds(self.mask_log_odds, self.expected_bleed),
        )  # fmt: skip
        return keep_points(clusters, around.kept(claimed, judged))
