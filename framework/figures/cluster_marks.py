"""Colors of a frame's clusters in the refinement figure, and the pixels that the refiner drops or adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Array, Bool, Frame, Int32, PointClusters, UInt8
from framework.evaluation.refined_points import Refinement, pixel_index, point_counts
from framework.rendering.palette import instance_colors

DROPPED = (214, 28, 44)  # RGB
DROPPED_DISTANCE = 160  # minimum sum of the channel differences between a cluster color and DROPPED


@dataclass(frozen=True)
class ClusterMarks:
    """The clusters before or after refinement, with their drawing styles."""

    heading: str
    clusters: PointClusters
    colors: UInt8  # (K, 3) RGB
    owner: Int32  # (H, W) smallest cluster that contains the pixel, -1 = none
    dropped: Bool  # (H, W) True where a pixel is in a cluster before refinement, but not after it
    added: Bool  # (H, W) True where a pixel is not in the original cluster of its owner

    @classmethod
    def before(cls, refinement: Refinement) -> ClusterMarks:
        clusters, frame = refinement.before, refinement.frame
        owner = _owner(clusters, frame)
        nowhere = np.zeros(owner.shape, np.bool_)
        return cls("before", clusters, _colors(len(clusters)), owner, nowhere, nowhere)

    @classmethod
    def after(cls, refinement: Refinement) -> ClusterMarks:
        before, after, frame = refinement.before, refinement.after, refinement.frame
        # a point is identified by its original cluster and its pixel
        origin = np.append(refinement.origin, -1)[after.cluster]
        keys_before = before.cluster.astype(np.int64) * frame.depth.size + pixel_index(before, frame)
        keys_after = origin.astype(np.int64) * frame.depth.size + pixel_index(after, frame)
        new = ~np.isin(keys_after, keys_before[before.cluster >= 0])
        owner = _owner(after, frame)
        added = np.asarray(_painted(after, frame, new, False), np.bool_)
        dropped = (_owner(before, frame) >= 0) & (owner < 0)
        return cls("after", after, _colors_after(refinement), owner, dropped, added)

    def mask(self, k: int) -> Bool:
        """Return the mask (H, W) of cluster k."""
        mask = np.zeros(self.owner.shape, np.bool_)
        u, v = self.clusters.pixels[self.clusters.cluster == k].T
        mask[v, u] = True
        return mask

    def by_size(self) -> list[int]:
        """Return the indices of the nonempty clusters, largest first."""
        sizes = point_counts(self.clusters)
        return [k for k in np.argsort(-sizes, kind="stable").tolist() if sizes[k]]

    def name(self, k: int) -> str:
        """Return the class and score of cluster k."""
        probabilities = self.clusters.class_probabilities[k]
        label = self.clusters.classes[int(probabilities.argmax())] if len(probabilities) else "object"
        return f"{label} {self.clusters.scores[k]:.2f}"


def _colors(count: int) -> UInt8:
    """Return RGB colors (count, 3) that differ from each other and from DROPPED."""
    palette = instance_colors(np.zeros((2 * count + 8, 3)))
    unlike = np.abs(palette.astype(np.int64) - DROPPED).sum(axis=1) > DROPPED_DISTANCE
    return np.asarray(palette[unlike][:count])


def _colors_after(refinement: Refinement) -> UInt8:
    """Return the RGB colors (M, 3). The largest part of a cluster has its color; all other parts have new colors."""
    n, m = len(refinement.before), len(refinement.after)
    color_index = np.full(m, -1)
    known = np.flatnonzero(refinement.main_part >= 0)
    color_index[refinement.main_part[known]] = known
    color_index[color_index < 0] = n + np.arange((color_index < 0).sum())
    return np.asarray(_colors(n + m)[color_index])


def _owner(clusters: PointClusters, frame: Frame) -> Int32:
    return np.asarray(_painted(clusters, frame, clusters.cluster, -1), np.int32)


def _painted(clusters: PointClusters, frame: Frame, values: Array, nothing: int) -> Array:
    """Return the values (P,) of the points as an image (H, W), with small clusters in front of large ones.

    Pixels outside all clusters have the value `nothing`.
    """
    held = np.flatnonzero(clusters.cluster >= 0)
    held = held[np.argsort(-point_counts(clusters)[clusters.cluster[held]], kind="stable")]
    image = np.full(frame.depth.size, nothing, values.dtype)
    image[pixel_index(clusters, frame)[held]] = values[held]
    return image.reshape(frame.depth.shape)
