"""Data association: which instance of the map is each cluster of the frame?

A cluster's pixels vote for the instances that the map holds at the surface measured there. Which pairs may match is
said by their overlap, by default over the smaller of the two, so that a part of an object still finds the whole; among
those, one cluster gets at most one instance and the reverse, best IoU first, so that a table does not get the book that
lies on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Float32, Int32, PointClusters
from framework.geometry import require_pixels_inside
from framework.mapping.evidence import Evidence, best_instance
from framework.mapping.sensor import Pinhole, seen_point
from framework.mapping.voxel_grid import Grid, find_block
from framework.mapping.voxel_walk import voxel_number


class OverlapRule(Enum):
    """What shared pixels are compared with."""

    SMALLER = "the smaller of cluster and instance: a part of an object still finds the whole"
    IOU = "all pixels of either"
    CLUSTER = "the cluster: a small part of an object finds it, the whole may not"


@dataclass(frozen=True)
class Overlaps:
    """How N clusters lie on the M instances that the frame sees."""

    instance_ids: Int32  # (M,) ascending
    visible: Int32  # (M,) pixels that see each instance
    sizes: Int32  # (N,) pixels of each cluster
    votes: Int32  # (N, M) pixels of both

    def by(self, rule: OverlapRule, least: int) -> npt.NDArray[np.float64]:
        """(N, M) overlaps in [0, 1] by one of the rules, with `least` as in `over_smaller`."""
        if rule is OverlapRule.CLUSTER:
            return np.asarray(self.votes / np.maximum(self.sizes[:, None], least))
        return self.over_smaller(least) if rule is OverlapRule.SMALLER else self.over_union(least)

    def over_union(self, least: int) -> npt.NDArray[np.float64]:
        """(N, M) shared pixels over those of cluster or visible instance, counted as at least `least`, in [0, 1]."""
        union = self.sizes[:, None] + self.visible[None, :] - self.votes
        return np.asarray(self.votes / np.maximum(union, least))

    def over_smaller(self, least: int) -> npt.NDArray[np.float64]:
        """(N, M) shared pixels over the smaller of cluster and visible instance, in [0, 1].

        The smaller one counts for at least `least` pixels: a few stray voxels of an instance under a cluster would
        otherwise overlap it completely, and win it from the instance that it belongs to.
        """
        return self.votes / np.maximum(np.minimum(self.sizes[:, None], self.visible[None, :]), least)


class PixelLists(NamedTuple):
    """The cluster points of each pixel as linked lists: a pixel under overlapping masks has several."""

    first: Int32  # (H, W) the first point, -1 = under no cluster
    next: Int32  # (P,) the next point of the same pixel, -1 = last


@njit(cache=True, nogil=True)
def _link_points(pixels, cluster, first, following):
    """Whether all pixels lie in the image; links the points up to the one that does not."""
    first[:] = -1
    for p in range(pixels.shape[0] - 1, -1, -1):
        u, v = pixels[p, 0], pixels[p, 1]
        if not (0 <= u < first.shape[1] and 0 <= v < first.shape[0]):
            return False
        if cluster[p] >= 0:
            following[p] = first[v, u]
            first[v, u] = p
    return True


def list_points_by_pixel(clusters: PointClusters, shape: tuple[int, int]) -> PixelLists:
    """The points of `clusters` by the pixel of the (height, width) image that they were seen at, in order.

    Raises DataError when a pixel lies outside the image.
    """
    lists = PixelLists(np.empty(shape, np.int32), np.empty(len(clusters.cluster), np.int32))
    if not _link_points(clusters.pixels, clusters.cluster, lists.first, lists.next):
        require_pixels_inside(clusters, shape)
    return lists


@njit(cache=True, nogil=True, parallel=True)
def look_up_instances(
    grid: Grid, evidence: Evidence, depth: Float32, view: Pinhole, stride: int, instance_ids: Int32
) -> None:
    """Fills instance_ids (ceil(H / stride), ceil(W / stride)) with the instance of the voxel nearest to every stride-th
    reading of every stride-th row of `depth` (H, W); 0 = none.

    This is the view of the map at the measured surface: unlike a ray-cast it cannot see an instance behind an object
    that is new, and it costs one look-up a pixel. `view` holds T_world_camera.
    """
    scale = np.float32(1.0) / grid.voxel_size
    half = np.float32(0.5)
    for row in prange(instance_ids.shape[0]):
        key = np.int64(-2)
        region = np.int32(-1)
        for column in range(instance_ids.shape[1]):
            instance_ids[row, column] = 0
            z = depth[row * stride, column * stride]
            if z <= np.float32(0.0):
                continue
            x, y, w = seen_point(view, column * stride, row * stride, z)
            i = int(np.floor(x * scale + half))
            j = int(np.floor(y * scale + half))
            k = int(np.floor(w * scale + half))
            block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
            if block >= 0 and grid.label_row[block] >= 0:
                instance_ids[row, column] = best_instance(evidence, grid.label_row[block], voxel_number(i, j, k))


@njit(cache=True, nogil=True)
def _count_visible(instance_ids, visible):
    """Adds to visible (ids + 1,) the pixels of each instance, by runs: a counter raised by one waits for itself."""
    label, count = np.int32(0), 0
    for found in instance_ids.flat:
        if found != label:
            visible[label] += count
            label, count = found, 0
        count += 1
    visible[label] += count


@njit(cache=True, nogil=True)
def _count_votes(pixels, cluster, instance_ids, stride, column, votes):
    """Adds to votes (N, M + 1) the points of each cluster that fall on the instance of each column, by runs.

    Divisions cost more than all the rest, so that of each coordinate is looked up; -1 = not a multiple of the stride.
    """
    sample = np.full(stride * max(instance_ids.shape), -1, np.int32)
    sample[::stride] = np.arange(max(instance_ids.shape))
    k, label, count = np.int32(0), np.int32(0), 0
    for p in range(pixels.shape[0]):
        u, v = sample[pixels[p, 0]], sample[pixels[p, 1]]
        if cluster[p] >= 0 and u >= 0 and v >= 0:
            found = instance_ids[v, u]
            if found != label or cluster[p] != k:
                if count > 0:
                    votes[k, column[label]] += count
                k, label, count = cluster[p], found, 0
            count += 1
    if count > 0:
        votes[k, column[label]] += count


def count_overlaps(clusters: PointClusters, instance_ids: Int32, stride: int = 1) -> Overlaps:
    """Votes of the clusters' pixels on `instance_ids` (h, w), the instances seen at every stride-th pixel.

    Each sample counts for the stride^2 pixels that it stands for.
    """
    visible = np.zeros(instance_ids.max() + 1, np.int32)
    _count_visible(instance_ids, visible)
    visible[0] = 0
    seen = np.flatnonzero(visible)
    column = np.full(len(visible), len(seen), np.int32)  # of each id in votes; the last one stands for no instance
    column[seen] = np.arange(len(seen), dtype=np.int32)
    votes = np.zeros((len(clusters), len(seen) + 1), np.int32)
    _count_votes(clusters.pixels, clusters.cluster, instance_ids, stride, column, votes)
    return Overlaps(
        instance_ids=seen.astype(np.int32),
        visible=visible[seen] * stride**2,
        sizes=votes.sum(axis=1, dtype=np.int32) * stride**2,
        votes=votes[:, :-1] * stride**2,
    )


def class_agreement(clusters: Float32, instances: Float32) -> npt.NDArray[np.float64]:
    """(N, M) how alike distributions (N, C) and (M, C) are: their Bhattacharyya coefficient, in [0, 1], 1 = equal."""
    return np.asarray(np.sqrt(clusters.astype(np.float64)) @ np.sqrt(instances.astype(np.float64)).T)


def match_one_to_one(allowed: Bool, preference: npt.NDArray[np.float64]) -> Int32:
    """(N,) the column that each row is matched with, -1 = none: of the `allowed` pairs (N, M) the most preferred first.

    Ties go to the smaller column, then to the smaller row.
    """
    match = np.full(len(allowed), -1, np.int32)
    rows, columns = np.nonzero(allowed)
    taken = np.zeros(allowed.shape[1], np.bool_)
    for i in np.lexsort((rows, columns, -preference[rows, columns])):
        row, column = rows[i], columns[i]
        if match[row] < 0 and not taken[column]:
            match[row] = column
            taken[column] = True
    return match


@njit(cache=True, nogil=True)
def _count_shared(first_point, next_point, cluster, shared):
    """Adds to shared (N, N) the pixels that each two clusters have in common, itself on the diagonal."""
    for pixel in range(first_point.size):
        p = first_point.flat[pixel]
        while p >= 0:
            q = first_point.flat[pixel]
            while q >= 0:
                shared[cluster[p], cluster[q]] += 1
                q = next_point[q]
            p = next_point[p]


def cover_another(clusters: PointClusters, points: PixelLists, threshold: float) -> Bool:
    """(N,) clusters that share more than `threshold` of the smaller one's pixels with a cluster of a better score.

    Such a cluster is most likely the same object found twice and must not become an instance of its own.
    """
    n = len(clusters)
    shared = np.zeros((n, n), np.int32)
    _count_shared(points.first, points.next, clusters.cluster, shared)
    sizes = shared.diagonal()
    over_smaller = shared / np.maximum(np.minimum(sizes[:, None], sizes[None, :]), 1)
    rank = np.lexsort((np.arange(n), -clusters.scores)).argsort()
    better = rank[None, :] < rank[:, None]
    return np.asarray((better & (over_smaller > threshold)).any(axis=1))


@njit(cache=True, nogil=True, parallel=True)
def _keep_on_top(first, following, cluster, sizes, share, kept_first, kept_following):
    """Copies each pixel's list without the points of clusters that one of less than `share` of their size lies on."""
    for v in prange(first.shape[0]):
        for u in range(first.shape[1]):
            p = first[v, u]
            smallest = np.float64(np.inf)
            while p >= 0:
                size = sizes[cluster[p]]
                if size > 0:
                    smallest = min(smallest, size)
                p = following[p]
            kept_first[v, u] = -1
            last = np.int32(-1)
            p = first[v, u]
            while p >= 0:
                if smallest >= share * sizes[cluster[p]]:
                    if last < 0:
                        kept_first[v, u] = p
                    else:
                        kept_following[last] = p
                    kept_following[p] = -1
                    last = p
                p = following[p]


def keep_on_top(clusters: PointClusters, points: PixelLists, instance_ids: Int32, share: float) -> PixelLists:
    """`points` where small clusters have for themselves what large ones claim as well.

    A network draws a large mask coarsely, over the small thing that lies on the object: a book on a couch. Under
    overlapping clusters a pixel is left to those that are not more than 1 / `share` times as large as the smallest
    there. Clusters without an instance (`instance_ids` (N,) 0) take nothing from others.
    """
    sizes = np.bincount(clusters.cluster[clusters.cluster >= 0], minlength=len(clusters))
    sizes = np.where(instance_ids > 0, sizes, 0)
    kept = PixelLists(np.empty_like(points.first), np.empty_like(points.next))
    _keep_on_top(points.first, points.next, clusters.cluster, sizes, share, kept.first, kept.next)
    return kept
