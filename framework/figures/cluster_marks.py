"""How a frame's clusters are marked in a picture: colours, what was dropped, what was added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Array, Bool, Frame, Int32, PointClusters, UInt8
from framework.evaluation.refined_points import Refinement, pixel_index, point_counts
from framework.figures.drawing import DROPPED
from framework.rendering.palette import instance_colors

LIKE_DROPPED = 160  # sum of the differences in red, green and blue up to which a colour is too much like that


@dataclass(frozen=True)
class ClusterMarks:
    """The clusters of one column of the picture, and how they are marked."""

    heading: str
    clusters: PointClusters
    colors: UInt8  # (K, 3)
    owner: Int32  # (H, W) the cluster that shows: of several over a pixel the smallest; -1 = none
    dropped: Bool  # (H, W) in some cluster before, in none now
    added: Bool  # (H, W) new in the cluster that shows

    @classmethod
    def before(cls, refinement: Refinement) -> ClusterMarks:
        clusters, frame = refinement.before, refinement.frame
        owner = _owner(clusters, frame, point_counts(clusters))
        nowhere = np.zeros(owner.shape, np.bool_)
        return cls("before", clusters, _colors(len(clusters)), owner, nowhere, nowhere)

    @classmethod
    def after(cls, refinement: Refinement) -> ClusterMarks:
        before, after, frame = refinement.before, refinement.after, refinement.frame
        # points that come from the same cluster's same pixel are the same
        origin = np.append(refinement.origin, -1)[after.cluster]
        size = frame.depth.size
        keys_before = before.cluster.astype(np.int64) * size + pixel_index(before, frame)
        keys_after = origin.astype(np.int64) * size + pixel_index(after, frame)
        new = ~np.isin(keys_after, keys_before[before.cluster >= 0])
        sizes = point_counts(after)
        owner = _owner(after, frame, sizes)
        added = _painted(after, frame, sizes, new, False)
        was = _owner(before, frame, refinement.points_before) >= 0
        return cls("after", after, _colors_after(refinement), owner, was & (owner < 0), np.asarray(added, np.bool_))

    def mask(self, k: int) -> Bool:
        """(H, W) of cluster k."""
        mask = np.zeros(self.owner.shape, np.bool_)
        u, v = self.clusters.pixels[self.clusters.cluster == k].T
        mask[v, u] = True
        return mask

    def by_size(self) -> list[int]:
        """The clusters that have points, the largest first."""
        sizes = point_counts(self.clusters)
        order = np.argsort(-sizes, kind="stable")
        return [k for k in order.tolist() if sizes[k]]


def _colors(count: int) -> UInt8:
    """(count, 3) colours unlike each other, wherever the objects are, as all are near in the view from the side.

    Colours that could be taken for that of dropped points are left out.
    """
    palette = instance_colors(np.zeros((2 * count + 8, 3)))
    unlike = np.abs(palette.astype(np.int64) - DROPPED).sum(axis=1) > LIKE_DROPPED
    return np.asarray(palette[unlike][:count])


def _colors_after(refinement: Refinement) -> UInt8:
    """(M, 3) the largest part of a cluster keeps its colour; further parts, and clusters from nowhere, get new ones."""
    n, m = len(refinement.before), len(refinement.after)
    color_index = np.full(m, -1)
    known = np.flatnonzero(refinement.main_part >= 0)
    color_index[refinement.main_part[known]] = known
    color_index[color_index < 0] = n + np.arange((color_index < 0).sum())
    return np.asarray(_colors(n + m)[color_index])


def _owner(clusters: PointClusters, frame: Frame, sizes: Int32) -> Int32:
    """(H, W) the smallest cluster over each pixel, -1 = none."""
    return np.asarray(_painted(clusters, frame, sizes, clusters.cluster, -1), np.int32)


def _painted(clusters: PointClusters, frame: Frame, sizes: Int32, values: Array, nothing: int) -> Array:
    """(H, W) the values (P,) of the points, those of small clusters over those of large ones."""
    held = np.flatnonzero(clusters.cluster >= 0)
    held = held[np.argsort(-sizes[clusters.cluster[held]], kind="stable")]
    image = np.full(frame.depth.size, nothing, values.dtype)
    image[pixel_index(clusters, frame)[held]] = values[held]  # of several the last one stays
    return image.reshape(frame.depth.shape)


def name_of(clusters: PointClusters, k: int) -> str:
    """Class and score of cluster k."""
    probabilities = clusters.class_probabilities[k]
    label = clusters.classes[int(probabilities.argmax())] if len(probabilities) else "object"
    return f"{label} {clusters.scores[k]:.2f}"
