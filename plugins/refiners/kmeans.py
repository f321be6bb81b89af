"""Cluster refinement by k-means: the conventional alternative that the paper compares its mixture with."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.mixtures import lloyd_iterations
from framework.refinement.mixtures.initialization import start_centers
from framework.refinement.neighborhood import Ring, surroundings
from framework.refinement.selection import keep_points


@dataclass
class KMeans(ClusterRefiner):
    """Drops the points that lie nearer to a center of the background than to one of the object.

    Lloyd's algorithm once for each mask, on the mask's points and the same ring around it that `gmm_em` uses: the
    object's centers start at the means of the mask cut into equal parts by depth, the background's likewise in
    the ring. Clusters only shrink: a dropped point leaves the arrays, clusters keep their index. Clusters with fewer
    than `min_points` points, or with as few in their ring, are left as they are.
    """

    object_centers: int = 5  # from 1
    background_centers: int = 5  # from 1
    max_iterations: int = 20  # from 1; it ends sooner when no label changes
    ring: Ring = field(default_factory=Ring)

    def __post_init__(self) -> None:
        check_bounds(
            self,
            object_centers=(1, 64),
            background_centers=(1, 64),
            max_iterations=(1, 1000),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring)
        sample = around.sampled(self.ring.max_points)
        start = start_centers(sample, self.object_centers, self.background_centers)
        _, centers = lloyd_iterations.cluster(sample.points_camera, sample.starts, start, self.max_iterations)
        own, judged = around.own(), around.of_at_least(self.ring.min_points)
        ends = own.starts[:-1] + np.where(judged, own.mask_counts, 0)
        labels = lloyd_iterations.nearest_centers(own.points_camera, own.starts[:-1], ends, centers)
        return keep_points(clusters, around.kept(labels < self.object_centers, judged))
