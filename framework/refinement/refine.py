"""One refiner on the clusters of one frame, with what holds for all refiners."""

from __future__ import annotations

from typing import cast

from framework.data import Frame, PointClusters
from framework.errors import DataError
from framework.geometry import require_pixels_inside
from framework.interfaces import ClusterRefiner


def refine(refiner: ClusterRefiner, clusters: PointClusters, frame: Frame) -> PointClusters:
    """What the refiner makes of the clusters. True masks pass as they are: cleaning the truth could only damage it.

    Raises DataError when the refiner returns no clusters, or has made up pixels: whoever comes next indexes the frame
    with them unchecked.
    """
    if clusters.exact:
        return clusters
    refined = refiner.refine(clusters, frame)
    if not isinstance(cast(object, refined), PointClusters):
        raise DataError(f"frame {frame.index}: a refiner must return PointClusters, found {type(refined).__name__}")
    require_pixels_inside(refined, frame.depth.shape)
    return refined
