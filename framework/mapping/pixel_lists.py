"""The cluster points of each pixel: masks overlap, and a pixel may lie under several.

What clusters share decides which of two is the same object found twice, and which of two lies on top of the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from framework.data import Bool, Int32, PointClusters
from framework.geometry import require_pixels_inside
from framework.mapping.voxel_grid import device


class PixelLists(NamedTuple):
    """The cluster points of each pixel as linked lists: a pixel under overlapping masks has several."""

    first: Int32  # (H, W) the first point, -1 = under no cluster
    next: Int32  # (P,) the next point of the same pixel, -1 = last

    def copy(self) -> PixelLists:
        return PixelLists(self.first.copy(), self.next.copy())


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


@device
def _append(first, following, v, u, last, p):
    """Puts point p at the end of the list of pixel (u, v), behind `last`, -1 = it is empty; returns p."""
    if last < 0:
        first[v, u] = p
    else:
        following[last] = p
    following[p] = -1
    return p


@njit(cache=True, nogil=True)
def count_labels(labels, counts):
    """Adds to counts (n,) how often each of labels (L,) occurs, in [0, n); -1 is counted as n - 1.

    By runs: a counter raised by one waits for itself.
    """
    label, count = np.int32(0), 0
    for found in labels:
        if found != label:
            counts[label] += count
            label, count = found, 0
        count += 1
    counts[label] += count


@njit(cache=True, nogil=True)
def _keep_on_top(pixels, first, following, cluster, sizes, share, kept_first, kept_following):
    """Makes those lists anew, of copies, that are without the points of clusters that one of less than `share` of their
    size lies on.
    """
    for begin in range(pixels.shape[0]):
        if cluster[begin] < 0 or following[begin] < 0:
            continue  # nothing lies on another here: so it is nearly everywhere
        u, v = pixels[begin, 0], pixels[begin, 1]
        if first[v, u] != begin:
            continue
        smallest = np.float64(np.inf)
        p = first[v, u]
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
                last = _append(kept_first, kept_following, v, u, last, p)
            p = following[p]


def keep_on_top(clusters: PointClusters, points: PixelLists, instance_ids: Int32, share: float) -> PixelLists:
    """`points` where small clusters have for themselves what large ones claim as well.

    A network draws a large mask coarsely, over the small thing that lies on the object: a book on a couch. Under
    overlapping clusters a pixel is left to those that are not more than 1 / `share` times as large as the smallest
    there. Clusters without an instance (`instance_ids` (N,) 0) take nothing from others; nobody does with share 0.
    """
    if share == 0:
        return points
    counts = np.zeros(len(clusters) + 1, np.int32)
    count_labels(clusters.cluster, counts)
    sizes = np.where(instance_ids > 0, counts[:-1], 0)
    kept = points.copy()
    _keep_on_top(clusters.pixels, points.first, points.next, clusters.cluster, sizes, share, kept.first, kept.next)
    return kept


@njit(cache=True, nogil=True)
def _leave_to_others(pixels, cluster, lying, seen, stride, first, following):
    """Takes the points of clusters on which the instance seen there lies out of the lists."""
    bottom = np.zeros(lying.shape[0], np.bool_)  # clusters that something lies on
    for k in range(lying.shape[0]):
        bottom[k] = lying[k].any()
    for p in range(pixels.shape[0]):
        if cluster[p] < 0 or not bottom[cluster[p]]:
            continue
        u, v = pixels[p, 0], pixels[p, 1]
        if not lying[cluster[p], seen[v // stride, u // stride]]:
            continue
        if first[v, u] == p:
            first[v, u] = following[p]
            continue
        before = first[v, u]
        while before >= 0 and following[before] != p:
            before = following[before]
        if before >= 0:  # else p is in no list
            following[before] = following[p]


def leave_to_others(clusters: PointClusters, points: PixelLists, lying: Bool, seen: Int32, stride: int) -> PixelLists:
    """`points` without those of clusters where the map has an instance that is `lying` (N, ids + 1) on them.

    `seen` holds the map's instance at every stride-th pixel of every stride-th row.
    """
    kept = points.copy()
    _leave_to_others(clusters.pixels, clusters.cluster, lying, seen, stride, kept.first, kept.next)
    return kept
