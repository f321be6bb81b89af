"""Points of each mask and of a ring around it.

The ring contains the surroundings of the object. A custom kernel computes the distances to the border of a mask,
because OpenCV would need two passes per mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Camera, Float32, Frame, Int64, PointClusters
from framework.refinement.neighborhood_kernels import (
    Int16,
    ThreadSchedule,
    Windows,
    bound,
    gather,
    grouped,
    ramps,
    share_among_threads,
    signed_distances,
)

MAX_RING_WIDTH = 80  # maximum width of a ring, px; wider rings add no information about the object


@dataclass(frozen=True)
class Neighborhoods:
    """Points of N masks and their rings.

    Neighborhood k is `points_camera[starts[k]:starts[k + 1]]`. Its first `mask_counts[k]` points belong to the mask,
    and the others belong to the ring.
    """

    points_camera: Float32  # (S, 3) m, camera frame
    depth_in_mask: Float32  # (S,) distance to the border of the mask, px, positive in the mask, negative in the ring
    starts: Int64  # (N + 1,) start of each neighborhood
    mask_counts: Int64  # (N,) number of points of each mask
    ring_widths: Int64  # (N,) width of each ring, px
    mask_radii: Float32  # (N,) largest `depth_in_mask` of the mask, px; 0 for an empty cluster

    def __len__(self) -> int:
        return len(self.mask_counts)

    @property
    def ring_counts(self) -> Int64:
        """Number of points (N,) of each ring."""
        return np.asarray(np.diff(self.starts) - self.mask_counts)

    @property
    def of_ring(self) -> Bool:
        """Boolean array (S,), True for points in a ring."""
        parts = np.stack([self.mask_counts, self.ring_counts], axis=1).ravel()
        return np.repeat(np.arange(len(parts)) % 2 == 1, parts)

    def mask_log_odds(self, largest: float, expected_bleed: float) -> Float32:
        """Return the log-odds (S,) of each point for the object, from its distance to the border of the mask.

        The log-odds change linearly from `largest` inside the mask to -`largest` outside. They are 0 at some distance
        inside the border, because masks often extend beyond the object. Thin masks get a shorter ramp, so that their
        center reaches `largest`.

        Args:
            largest: The maximum log-odds.
            expected_bleed: The distance of the zero from the border, in ring widths.
        """
        reach = np.maximum(np.minimum(self.ring_widths, self.mask_radii), 1).astype(np.float32)
        log_odds, widths = np.empty_like(self.depth_in_mask), reach * np.float32(1 - expected_bleed)
        ramps(self.depth_in_mask, self.starts, widths, expected_bleed, largest, log_odds)
        return log_odds


@dataclass(frozen=True)
class Surroundings:
    """The clusters of one frame and their rings."""

    clusters: PointClusters
    frame: Frame
    order: slice | Int64  # indices of the M points of all clusters, cluster by cluster
    windows: Windows
    steps: Int16  # (cells,) signed distance in thirds of a pixel: above 0 in the mask, below 0 in the ring, otherwise 0
    ring_counts: Int64  # (N,) number of depth readings in each ring
    ring_widths: Int64  # (N,) width of each ring, px
    mask_radii: Float32  # (N,) maximum distance to the border in each mask, px

    @property
    def mask_counts(self) -> Int64:
        """Number of points (N,) of each cluster."""
        return np.diff(self.windows.firsts)

    def of_at_least(self, min_points: int) -> Bool:
        """Return a Boolean array (N,), True for clusters with at least `min_points` points in the mask and in the ring.

        If the width of the ring is 0, only the mask is checked.
        """
        return np.asarray(
            (self.mask_counts >= min_points) & ((self.ring_counts >= min_points) | (self.ring_widths == 0))
        )

    def sampled(self, max_points: int) -> Neighborhoods:
        """Return the neighborhoods with at most `max_points` evenly sampled points each."""
        counts = self.mask_counts + self.ring_counts
        nth = np.maximum(-(-counts // max_points), 1)
        return self._gathered(-(-counts // nth), -(-self.mask_counts // nth), nth)

    def own(self) -> Neighborhoods:
        """Return the neighborhoods with all points of the clusters and with empty rings."""
        return self._gathered(self.mask_counts, self.mask_counts, np.ones_like(self.ring_counts))

    def kept(self, good: Bool, judged: Bool) -> Bool:
        """Return a Boolean array (P,) over the points of all clusters, True for points to keep.

        Args:
            good: A Boolean array (M,) in the order of own(), True for points to keep.
            judged: A Boolean array (N,), True for the clusters that `good` applies to. Other clusters keep all points.
        """
        kept = np.ones(len(self.clusters.cluster), np.bool_)
        kept[self.order] = good | np.repeat(~judged, self.mask_counts)
        return kept

    def _gathered(self, counts: Int64, mask_counts: Int64, nth: Int64) -> Neighborhoods:
        starts = np.concatenate([[0], np.cumsum(counts)])
        points, depth_in_mask = np.empty((starts[-1], 3), np.float32), np.empty(starts[-1], np.float32)
        gather(
            self.windows, self.steps, self.frame.depth, pinhole(self.frame.camera), starts, mask_counts, nth,
            thread_schedule(counts), points, depth_in_mask,
        )  # fmt: skip
        return Neighborhoods(points, depth_in_mask, starts, mask_counts, self.ring_widths, self.mask_radii)


@dataclass
class Ring:
    """Parameters of the ring around a mask, and limits on the number of points."""

    ring_fraction: float = 0.25  # ratio of the ring's width to the square root of the mask's area, >= 0; 0 = no ring
    min_ring: int = 4  # minimum width of the ring, px, >= 1
    max_ring: int = 12  # maximum width of the ring, px, >= min_ring
    # maximum number of points of a mask and its ring for the fit, >= 100; all points are classified
    max_points: int = 1000
    min_points: int = 30  # minimum number of points of a mask and of its ring, >= 10; clusters below it stay unchanged

    def __post_init__(self) -> None:
        check_bounds(
            self, ring_fraction=(0.0, 10.0), min_ring=(1, MAX_RING_WIDTH), max_ring=(self.min_ring, MAX_RING_WIDTH),
            max_points=(100, 10**9), min_points=(10, 10**9),
        )  # fmt: skip

    def without_ring(self) -> Ring:
        return replace(self, ring_fraction=0.0)


def surroundings(clusters: PointClusters, frame: Frame, ring: Ring) -> Surroundings:
    """Return the clusters of one frame with their rings.

    A ring contains the depth readings around the mask, including those of other clusters. Its width is proportional to
    the square root of the number of points of the cluster. Readings of known structure, such as floors, are omitted,
    because they are already separated from the object.
    """
    order, firsts = members(clusters)
    pixels, areas = clusters.pixels[order], np.diff(firsts)
    readings = frame.depth if clusters.structure is None else np.where(clusters.structure, np.float32(0), frame.depth)
    widths = np.clip(np.rint(ring.ring_fraction * np.sqrt(areas)), ring.min_ring, ring.max_ring).astype(np.int64)
    if ring.ring_fraction == 0:
        widths[:] = 0
    bounds = np.zeros((len(clusters), 4), np.int64)
    bound(pixels, firsts, np.maximum(widths, 1), *frame.camera.shape, bounds)  # the border of a mask needs a neighbor
    cells = np.concatenate([[0], np.cumsum((bounds[:, 2] - bounds[:, 0]) * (bounds[:, 3] - bounds[:, 1]))])
    windows, steps = Windows(pixels, firsts, bounds, cells), np.empty(cells[-1], np.int16)
    ring_counts, radii = np.zeros(len(widths), np.int64), np.zeros(len(widths), np.float32)
    signed_distances(windows, widths, readings, thread_schedule(areas), steps, ring_counts, radii)
    return Surroundings(clusters, frame, order, windows, steps, ring_counts, widths, radii)


def members(clusters: PointClusters) -> tuple[slice | Int64, Int64]:
    """Return the indices (M,) of the points sorted by cluster, and the start (N + 1,) of each cluster.

    Points that belong to no cluster are omitted.
    """
    if (clusters.cluster[:-1] <= clusters.cluster[1:]).all():  # as returned by lift(); a slice avoids a copy
        firsts = np.searchsorted(clusters.cluster, np.arange(len(clusters) + 1))
        return slice(int(firsts[0]), int(firsts[-1])), firsts - firsts[0]
    order, firsts = grouped(clusters.cluster, len(clusters))
    return order, firsts


def thread_schedule(costs: Int64) -> ThreadSchedule:
    """Assign each cluster to the thread with the least work, in order of decreasing cost.

    `costs` (N,) contains the number of points of each cluster. Numba would assign equal numbers of clusters, but a few
    large clusters contain most of the points.
    """
    longest_first = np.argsort(-costs, kind="stable")
    return ThreadSchedule(*share_among_threads(costs, longest_first, numba.get_num_threads()))


def pinhole(camera: Camera) -> Float32:
    """Return the intrinsics fx, fy, cx, cy, px, in single precision."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
