"""Cluster refinement by k-means.

In the paper, k-means only initializes a mixture.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures.lloyd_iterations import cluster, nearest_centers, start_centers
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.refine import keep_points


@dataclass
class KMeans(ClusterRefiner):
    """Removal of points nearer to a background center than to an object center.

    K-means runs on the points of each mask and of the ring around it. The object centers are initialized by groups of
    the points in the mask, and the background centers by groups of the points in the ring. Each group has the same
    number of points at similar depths. Clusters with too few points in the mask or the ring are not changed.
    """

    object_centers: int = 5  # number of centers of the object, in [1, 64]
    # number of centers of the background, in [0, 64]; 0 = no background model, all points are kept
    background_centers: int = 5
    max_iterations: int = 20  # maximum number of iterations, in [1, 1000]; stops early if no assignment changes
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(self, object_centers=(1, 64), background_centers=(0, 64), max_iterations=(1, 1000))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring if self.background_centers else self.ring.without_ring())
        sample = around.sampled(self.ring.max_points)
        start = start_centers(sample, self.object_centers, self.background_centers)
        _, centers = cluster(sample.points_camera, sample.starts, start, self.max_iterations)
        own, judged = around.own(), around.of_at_least(self.ring.min_points)
        ends = own.starts[:-1] + np.where(judged, own.mask_counts, 0)
        labels = nearest_centers(own.points_camera, own.starts[:-1], ends, centers)
        return keep_points(clusters, around.kept(labels < self.object_centers, judged))
