"""Each mask's points together with a ring of points around the mask: what tells an object from its background.

Distances to a mask's border are our own, as OpenCV's distance transform goes over each mask twice, inside and outside,
and takes twice as long (20 masks of redkitchen, one core).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Frame, Int32, Int64, PointClusters
from framework.refinement.neighborhood_kernels import (
    Int16,
    bound,
    gather,
    grouped,
    share_among_threads,
    signed_distances,
)

MAX_RING_WIDTH = 80  # px; wider rings tell nothing about the object


@dataclass(frozen=True)
class Neighborhoods:
    """Points of N masks, each followed by those of the ring around it, in one flat array.

    Neighborhood k is `points_camera[starts[k]:starts[k + 1]]`; its first `mask_counts[k]` points are the mask's own.
    """

    points_camera: Float32  # (S, 3) m
    depth_in_mask: Float32  # (S,) px to the mask's border: positive inside, negative in the ring
    starts: Int64  # (N + 1,)
    mask_counts: Int64  # (N,)
    ring_widths: Int64  # (N,) px
    mask_radii: Float32  # (N,) px, depth in the mask of its innermost pixel; 0 for an empty cluster

    def __len__(self) -> int:
        return len(self.mask_counts)

    @property
    def ring_counts(self) -> Int64:
        """(N,) points of each ring."""
        return np.asarray(np.diff(self.starts) - self.mask_counts)

    @property
    def of_ring(self) -> Bool:
        """(S,) which points are of a ring."""
        parts = np.stack([self.mask_counts, self.ring_counts], axis=1).ravel()
        return np.repeat(np.arange(len(parts)) % 2 == 1, parts)


@dataclass(frozen=True)
class Surroundings:
    """The clusters of one frame and where their rings are: what points can be gathered from."""

    clusters: PointClusters
    frame: Frame
    order: slice | Int64  # index of the M points of all clusters, one cluster after the other
    pixels: Int32  # (M, 2) (u, v) of these points
    firsts: Int64  # (N + 1,) where each cluster begins among them
    windows: Int64  # (N, 4) v0 u0 v1 u1 (half open), each cluster's bounding box grown by its ring
    cells: Int64  # (N + 1,) where each window's cells begin among all
    steps: Int16  # (cells,) thirds of a pixel: depth in the mask, below 0 in the ring, 0 in neither
    ring_counts: Int64  # (N,) readings in each ring
    ring_widths: Int64  # (N,) px
    mask_radii: Float32  # (N,) px

    @property
    def mask_counts(self) -> Int64:
        """(N,) points of each cluster."""
        return np.diff(self.firsts)

    def of_at_least(self, min_points: int) -> Bool:
        """(N,) which clusters have at least `min_points` points, and as many in their ring."""
        return np.asarray((self.mask_counts >= min_points) & (self.ring_counts >= min_points))

    def sampled(self, max_points: int) -> Neighborhoods:
        """Every n-th point of each neighborhood, n chosen so that at most `max_points` are left of it."""
        counts = self.mask_counts + self.ring_counts
        nth = np.maximum(-(-counts // max_points), 1)
        return self._gathered(-(-counts // nth), -(-self.mask_counts // nth), nth)

    def own(self) -> Neighborhoods:
        """The M points of the clusters, without the rings."""
        return self._gathered(self.mask_counts, self.mask_counts, np.ones_like(self.ring_counts))

    def kept(self, good: Bool, judged: Bool) -> Bool:
        """(P,) which points of the PointClusters stay: of the `judged` clusters (N,) the `good` (M,) ones of `own`.

        Points of clusters that were not judged stay, and so do those of no cluster.
        """
        kept = np.ones(len(self.clusters.cluster), np.bool_)
        kept[self.order] = good | np.repeat(~judged, self.mask_counts)
        return kept

    def _gathered(self, counts: Int64, mask_counts: Int64, nth: Int64) -> Neighborhoods:
        starts = np.concatenate([[0], np.cumsum(counts)])
        points, depth_in_mask = np.empty((starts[-1], 3), np.float32), np.empty(starts[-1], np.float32)
        gather(
            self.pixels, self.firsts, self.windows, self.cells, self.steps, self.frame.depth,
            pinhole(self.frame.camera), starts, mask_counts, nth, *thread_shares(counts), points, depth_in_mask,
        )  # fmt: skip
        return Neighborhoods(points, depth_in_mask, starts, mask_counts, self.ring_widths, self.mask_radii)


@dataclass
class Ring:
    """The band around a mask that shows what surrounds the object, and what a refiner looks at of both."""

    ring_fraction: float = 0.25  # width of the ring in square roots of the mask's area
    min_ring: int = 4  # px, least width
    max_ring: int = 12  # px, largest width
    max_points: int = 1000  # from 100, points of a mask and its ring that are fitted to; all are judged at the end
    min_points: int = 30  # from 10, smaller clusters or rings are too little

    def __post_init__(self) -> None:
        check_bounds(
            self,
            ring_fraction=(0.0, 10.0),
            min_ring=(1, MAX_RING_WIDTH),
            max_ring=(self.min_ring, MAX_RING_WIDTH),
            max_points=(100, 10**9),
            min_points=(10, 10**9),
        )


def surroundings(clusters: PointClusters, frame: Frame, ring: Ring) -> Surroundings:
    """The N clusters of one frame with their rings.

    A ring holds the pixels that have a depth reading, are not in the cluster themselves and lie within
    `ring_fraction` * sqrt(points in the cluster) px of it, bounded to [`min_ring`, `max_ring`] px. Pixels of other
    clusters belong to it like any other; those of known structure are as if they had no reading: they need not be told
    from the object any more, and are no border to it.
    """
    order, firsts = members(clusters)
    pixels, areas = clusters.pixels[order], np.diff(firsts)
    readings = frame.depth if clusters.structure is None else np.where(clusters.structure, np.float32(0), frame.depth)
    widths = np.clip(np.rint(ring.ring_fraction * np.sqrt(areas)), ring.min_ring, ring.max_ring).astype(np.int64)
    windows = np.zeros((len(clusters), 4), np.int64)
    bound(pixels, firsts, widths, *frame.camera.shape, windows)
    cells = np.concatenate([[0], np.cumsum((windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1]))])
    steps = np.empty(cells[-1], np.int16)
    ring_counts, radii = np.zeros(len(widths), np.int64), np.zeros(len(widths), np.float32)
    signed_distances(pixels, firsts, widths, windows, cells, readings, *thread_shares(areas), steps, ring_counts, radii)
    return Surroundings(clusters, frame, order, pixels, firsts, windows, cells, steps, ring_counts, widths, radii)


def members(clusters: PointClusters) -> tuple[slice | Int64, Int64]:
    """The points of all clusters, one cluster after the other: their index, and (N + 1,) where each cluster begins.

    Within a cluster the points keep their order. Points of no cluster (-1) are left out. The index is a slice, which
    spares a copy of what it is taken of, where points are in this order already, as geometry.lift leaves them.
    """
    if (clusters.cluster[:-1] <= clusters.cluster[1:]).all():
        firsts = np.searchsorted(clusters.cluster, np.arange(len(clusters) + 1))
        return slice(int(firsts[0]), int(firsts[-1])), firsts - firsts[0]
    order, firsts = grouped(clusters.cluster, len(clusters))
    return order, firsts


def thread_shares(costs: Int64) -> tuple[Int64, Int64]:
    """Which thread takes which of N clusters: (N,) their order and (threads + 1,) where each thread's share begins.

    Numba cuts a parallel loop into parts of equal length, but a few large clusters have most of the points. Here the
    costliest goes first, to the thread that has least to do (Graham 1969). Clusters do not know of each other, so that
    results do not depend on it.
    """
    order, starts = share_among_threads(costs, np.argsort(-costs, kind="stable"), numba.get_num_threads())
    return order, starts


def pinhole(camera: Camera) -> Float32:
    """(4,) fx, fy, cx, cy in the precision of geometry.back_project, for kernels."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
