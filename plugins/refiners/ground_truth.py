"""Refiner that uses the ground truth, an upper bound of refinement accuracy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Frame, PointClusters
from framework.detection.true_instances import frame_truth, true_objects
from framework.interfaces import ClusterRefiner
from framework.refinement.refine import keep_points


@dataclass
class GroundTruthRefiner(ClusterRefiner):
    """Selection of the points of each cluster that are on its ground-truth object.

    The object of a cluster is the one with most of its points, and at least a quarter of them. Clusters without such an
    object are false detections, and are not changed. The refiner raises DataError if the sequence has no instance
    ground truth.
    """

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        objects = np.append(true_objects(clusters, frame), 0)[clusters.cluster]  # 0 for points without a cluster
        u, v = clusters.pixels.T
        return keep_points(clusters, (objects == 0) | (frame_truth(frame).instance_ids[v, u] == objects))
