"""No refinement, for ablations."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner


@dataclass
class Identity(ClusterRefiner):
    """Unchanged clusters."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return clusters
