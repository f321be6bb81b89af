"""Cluster refinement by k-means: the conventional alternative that the paper compares its mixture with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.parameters import check_bounds
from framework.refinement import lloyd
from framework.refinement.mixture_start import start_centers
from framework.refinement.neighborhood import ring_bounds, surroundings
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
    ring_fraction: float = 0.25  # width of the ring in square roots of the mask's area
    min_ring: int = 4  # px, least width
    max_ring: int = 12  # px, largest width
    max_points: int = 1000  # from 100, points of a mask and its ring that k-means sees; all are judged at the end
    min_points: int = 30  # from 10, smaller clusters or rings are too little

    def __post_init__(self) -> None:
        check_bounds(
            self,
            object_centers=(1, 64),
            background_centers=(1, 64),
            max_iterations=(1, 1000),
            **ring_bounds(self.min_ring),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        around = surroundings(clusters, frame, self.ring_fraction, self.min_ring, self.max_ring)
        sample = around.sampled(self.max_points)
        start = start_centers(sample, self.object_centers, self.background_centers)
        _, centers = lloyd.cluster(sample.points_camera, sample.starts, start, self.max_iterations)
        own, judged = around.own(), around.of_at_least(self.min_points)
        ends = own.starts[:-1] + np.where(judged, own.mask_counts, 0)
        labels = lloyd.nearest_centers(own.points_camera, own.starts[:-1], ends, centers)
        return keep_points(clusters, around.kept(labels < self.object_centers, judged))
