"""One refiner on the clusters of one frame, with what holds for all refiners."""

from __future__ import annotations

from framework.data import Frame, PointClusters
from framework.geometry import require_pixels_inside
from framework.interfaces import ClusterRefiner


def refine(refiner: ClusterRefiner, clusters: PointClusters, frame: Frame) -> PointClusters:
    """What the refiner makes of the clusters. True masks pass as they are: cleaning the truth could only damage it.

    Raises DataError when the refiner has made up pixels: whoever comes next indexes the frame with them unchecked.
    """
    if clusters.exact:
        return clusters
    refined = refiner.refine(clusters, frame)
    require_pixels_inside(refined, frame.depth.shape)
    return refined
