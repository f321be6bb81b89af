"""Refiners in a row: each refines what the one before it has left."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from framework.data import Frame, PointClusters
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner
from framework.refinement.refine import refine


@dataclass
class Chain(ClusterRefiner):
    """Applies its links in their order. One that is null is left out, so that each link is an ablation of its own.

    `refiner.links.gmm_em=null` leaves one out, `refiner@refiner.links.gmm_em=kmeans` puts another in its place.
    """

    links: Mapping[str, ClusterRefiner]  # by name, at least one

    def __post_init__(self) -> None:
        if not self.links:
            raise ConfigError("refiner.links has no link left: choose refiner=identity")

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        for link in self.links.values():
            clusters = refine(link, clusters, frame)
        return clusters
