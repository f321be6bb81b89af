"""Refiner without refinement, for ablations."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner


@dataclass
class Identity(ClusterRefiner):
    """Refiner that returns the clusters unchanged."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return clusters
