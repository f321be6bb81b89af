"""Leaves the clusters as the masks made them: what "without refinement" means in an ablation."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner


@dataclass
class Identity(ClusterRefiner):
    """Passes the clusters on unchanged."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return clusters
