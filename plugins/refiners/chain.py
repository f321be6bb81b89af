"""Sequence of cluster refiners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from framework.data import Frame, PointClusters
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner
from framework.refinement.refine import refine


@dataclass
class Chain(ClusterRefiner):
    """Refiners that are applied one after the other.

    `refiner.links.gmm_em=null` removes the refiner `gmm_em`. `refiner@refiner.links.gmm_em=kmeans` replaces it.
    """

    links: Mapping[str, ClusterRefiner]  # refiners by name, in order, at least one

    def __post_init__(self) -> None:
        if not self.links:
            raise ConfigError(
                "refiner.links: expected at least one refiner, got none; set refiner=identity for no refinement"
            )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        for link in self.links.values():
            clusters = refine(link, clusters, frame)
        return clusters
