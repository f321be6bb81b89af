"""Overlaps of the clusters of a frame with the visible instances of the map."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from framework.data import Int32
from framework.mapping.instances.association_kernels import count_votes
from framework.mapping.labels.pixel_lists import PixelLists
from framework.mapping.labels.pixel_lists_kernels import CHUNKS


class OverlapRule(Enum):
    """Denominator of the overlap of a cluster and an instance."""

    SMALLER = "size of the smaller of cluster and instance, so that a part of an object matches the whole"
    IOU = "number of pixels in the union of cluster and instance"
    CLUSTER = "size of the cluster, so that a detected part of an object matches the whole; the reverse may fail"


@dataclass(frozen=True)
class Overlaps:
    """Overlap of the N clusters of a frame with the M visible instances."""

    instance_ids: Int32  # (M,) ascending
    visible: Int32  # (M,) number of pixels of each visible instance
    sizes: Int32  # (N,) number of pixels of each cluster
    votes: Int32  # (N, M) number of pixels shared by a cluster and an instance
    seen: Int32  # (h, w) instance at every stride-th pixel of every stride-th row, 0 = none
    stride: int  # distance between the samples in `seen`, px

    def by(self, rule: OverlapRule, min_pixels: int) -> npt.NDArray[np.float64]:
        """Return the overlaps (N, M), in [0, 1], with the given denominator, which is at least `min_pixels`."""
        if rule is OverlapRule.CLUSTER:
            return np.asarray(self.votes / np.maximum(self.sizes[:, None], min_pixels))
        return self.over_smaller(min_pixels) if rule is OverlapRule.SMALLER else self.over_union(min_pixels)

    def over_union(self, min_pixels: int) -> npt.NDArray[np.float64]:
        """Return the IoUs (N, M), with a union of at least `min_pixels`."""
        union = self.sizes[:, None] + self.visible[None, :] - self.votes
        return np.asarray(self.votes / np.maximum(union, min_pixels))

    def over_smaller(self, min_pixels: int) -> npt.NDArray[np.float64]:
        """Return the overlaps (N, M), relative to the smaller of cluster and visible instance.

        The denominator is at least `min_pixels`. Otherwise, an instance with a few stray voxels inside a cluster could
        match it instead of the correct instance.
        """
        return self.votes / np.maximum(np.minimum(self.sizes[:, None], self.visible[None, :]), min_pixels)


def count_overlaps(points: PixelLists, instance_ids: Int32, stride: int = 1) -> Overlaps:
    """Return the overlaps of clusters with the visible instances.

    Args:
        points: The lists of clusters at the pixels.
        instance_ids: The instance (h, w) at every stride-th pixel of every stride-th row, 0 = none.
        stride: The distance between the samples, px. Each sample counts as stride^2 pixels.
    """
    flat = instance_ids.ravel()
    seen = np.unique(flat[np.flatnonzero(np.diff(flat, prepend=0))])  # only the starts of runs, for speed
    seen = seen[seen > 0]
    by_chunk = np.zeros((CHUNKS, points.cluster_count + 1, len(seen) + 1), np.int32)
    count_votes(points, instance_ids, stride, seen, by_chunk)
    votes = by_chunk.sum(axis=0, dtype=np.int32) * np.int32(stride**2)
    return Overlaps(
        instance_ids=seen,
        visible=votes[-1, :-1],
        sizes=votes[:-1].sum(axis=1, dtype=np.int32),
        votes=votes[:-1, :-1],
        seen=instance_ids,
        stride=stride,
    )
