"""The clusters over each pixel: masks overlap, and a pixel may lie under several.

Pixels lie under few different combinations of clusters. Each combination is a list with a number, and an image has the
number of each pixel's list, so that what concerns lists costs next to nothing. What clusters share decides which of two
is the same object found twice, and which of two lies on top of the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Int32, PointClusters
from framework.geometry import require_pixels_inside
from framework.mapping.voxels.voxel_grid import device

CHUNKS = 16  # of image rows


class PixelLists(NamedTuple):
    """The clusters over each pixel, of N, as L lists: those of list i are cluster[first[i] : first[i + 1]]."""

    of_pixel: Int32  # (H, W) the number of each pixel's list; list 0 is empty
    pixels: Int32  # (L,) how many pixels have each list
    first: Int32  # (L + 1,)
    cluster: Int32  # (first[L],) in the order of the points
    cluster_count: int  # N


@device
def _are_inside(coordinates, width, height):
    """Whether all pixels (2 P,), u and v in turns, lie in the image. Unsigned, negative coordinates are large."""
    right = bottom = np.uint32(0)
    for p in range(coordinates.shape[0] // 2):
        right = max(right, np.uint32(coordinates[2 * p]))
        bottom = max(bottom, np.uint32(coordinates[2 * p + 1]))
    return right < width and bottom < height


@njit(cache=True, nogil=True)
def _link_points(coordinates, cluster, of_pixel, head, rest, child, sibling, count, length):
    """Gives each pixel the number of its list; returns how many lists there are, or 0 where a point lies outside.

    A list is its `head` before another one, the `rest`; child is the latest list with a list as its rest, and sibling
    the one before with the same rest. count is how many pixels have each list, length how many clusters it has. There
    must be room for a list more than there are points; their coordinates (2 P,) are u and v in turns.
    """
    width = of_pixel.shape[1]
    if not _are_inside(coordinates, width, of_pixel.shape[0]):
        return np.int32(0)
    of_pixel[:] = 0
    number = of_pixel.ravel()
    count[0], child[0], length[0] = of_pixel.size, 0, 0
    lists = np.int32(1)
    p = cluster.shape[0] - 1
    while p >= 0:  # a run of points of one cluster, at pixels that have had one list
        k, last = cluster[p], p
        if k < 0:
            p -= 1
            continue
        pixel = np.uint32(coordinates[2 * p + 1] * width + coordinates[2 * p])
        old = number[pixel]
        new = child[old]
        while new > 0 and head[new] != k:
            new = sibling[new]
        if new == 0:
            new = lists
            lists += np.int32(1)
            head[new], rest[new], length[new] = k, old, length[old] + 1
            count[new], child[new] = 0, 0
            child[old], sibling[new] = new, child[old]
        while True:
            number[pixel] = new
            p -= 1
            if p < 0 or cluster[p] != k:
                break
            pixel = np.uint32(coordinates[2 * p + 1] * width + coordinates[2 * p])
            if number[pixel] != old:
                break
        count[old] -= last - p
        count[new] += last - p
    return lists


@njit(cache=True, nogil=True)
def _write_lists(head, rest, first, cluster):
    for i in range(first.shape[0] - 1):
        number = i
        for place in range(first[i], first[i + 1]):
            cluster[place] = head[number]
            number = rest[number]


def list_points_by_pixel(clusters: PointClusters, shape: tuple[int, int]) -> PixelLists:
    """The clusters over each pixel of the (height, width) image, by the points that were seen there.

    Lists that no pixel has are empty.

    Raises DataError when a pixel lies outside the image.
    """
    of_pixel = np.empty(shape, np.int32)
    room = len(clusters.cluster) + 1
    head, rest, child, sibling, count, length = (np.empty(room, np.int32) for _ in range(6))
    lists = _link_points(clusters.pixels.ravel(), clusters.cluster, of_pixel, head, rest, child, sibling, count, length)
    if lists == 0:
        require_pixels_inside(clusters, shape)
    count = count[:lists].copy()
    first = _begins(np.where(count > 0, length[:lists], 0))
    cluster = np.empty(first[-1], np.int32)
    _write_lists(head, rest, first, cluster)
    return PixelLists(of_pixel, count, first, cluster, len(clusters))


def _begins(lengths: Int32) -> Int32:
    """(L + 1,) where lists of so many clusters begin, one behind the other, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


@njit(cache=True, nogil=True)
def _count_shared(pixels, first, cluster, shared):
    """Adds to shared (N, N) the pixels that each two clusters have in common, itself on the diagonal."""
    for i in range(pixels.shape[0]):
        for a in range(first[i], first[i + 1]):
            for b in range(first[i], first[i + 1]):
                shared[cluster[a], cluster[b]] += pixels[i]


def cover_another(points: PixelLists, scores: Float32, threshold: float) -> Bool:
    """(N,) clusters that share more than `threshold` of the smaller one's pixels with a cluster of a better score.

    Such a cluster is most likely the same object found twice and must not become an instance of its own.
    """
    n = points.cluster_count
    shared = np.zeros((n, n), np.int32)
    _count_shared(points.pixels, points.first, points.cluster, shared)
    sizes = shared.diagonal()
    over_smaller = shared / np.maximum(np.minimum(sizes[:, None], sizes[None, :]), 1)
    rank = np.lexsort((np.arange(n), -scores)).argsort()
    better = rank[None, :] < rank[:, None]
    return np.asarray((better & (over_smaller > threshold)).any(axis=1))


@njit(cache=True, nogil=True)
def _keep_on_top(pixels, first, cluster, instance_ids, share, kept_first, kept):
    """Fills kept_first (L + 1,) and kept, as long as cluster, of which the first kept_first[L] are set."""
    sizes = np.zeros(instance_ids.shape[0], np.float64)
    for i in range(pixels.shape[0]):
        for place in range(first[i], first[i + 1]):
            sizes[cluster[place]] += pixels[i]
    n = 0
    for i in range(pixels.shape[0]):
        kept_first[i] = n
        smallest = np.float64(np.inf)
        for place in range(first[i], first[i + 1]):
            if instance_ids[cluster[place]] > 0:
                smallest = min(smallest, sizes[cluster[place]])
        for place in range(first[i], first[i + 1]):
            k = cluster[place]
            if instance_ids[k] > 0 and smallest >= share * sizes[k]:
                kept[n] = k
                n += 1
    kept_first[pixels.shape[0]] = n


def keep_on_top(points: PixelLists, instance_ids: Int32, share: float) -> PixelLists:
    """Only the clusters with an instance (`instance_ids` (N,), 0 = none), of which small ones have for themselves what
    large ones claim as well.

    A network draws a large mask coarsely, over the small thing that lies on the object: a book on a couch. Under
    overlapping clusters a pixel is left to those that are not more than 1 / `share` times as large as the smallest
    there; with share 0 to all.
    """
    first, kept = np.empty_like(points.first), np.empty_like(points.cluster)
    _keep_on_top(points.pixels, points.first, points.cluster, instance_ids, share, first, kept)
    return points._replace(first=first, cluster=kept[: first[-1]])


@njit(cache=True, nogil=True, parallel=True)
def _renumber(of_pixel, seen, stride, column, number, renumbered, moved):
    """Fills renumbered (H, W) with number[i, column[k]] for a pixel with list i where the map has instance k.

    Counts in moved (CHUNKS, lists), of zeros before, the pixels that get another number.
    """
    height, width = of_pixel.shape
    for chunk in prange(CHUNKS):
        for v in range(chunk * height // CHUNKS, (chunk + 1) * height // CHUNKS):
            row, old_row, new_row = seen[v // stride], of_pixel[v], renumbered[v]
            new_row[:] = old_row
            for place in range(row.shape[0]):
                k = column[row[place]]
                for u in range(place * stride, min((place + 1) * stride, width) if k > 0 else 0):
                    old = old_row[u]
                    new = number[old, k]
                    new_row[u] = new
                    if new != old:
                        moved[chunk, new] += 1


@njit(cache=True, nogil=True)
def _lists_without(first, cluster, lying, instances, number, origin, ends, kept):
    """Fills number (L, 1 + J) with the list that each becomes where none and where each of `instances` (J,) is seen.

    New lists are numbered on: origin gets what each was made of, ends where its clusters end in kept. Returns how many
    lists these are, and of how many clusters in all.
    """
    lists = first.shape[0] - 1
    new = length = 0
    for i in range(lists):
        number[i, 0] = i
    for j in range(instances.shape[0]):
        for i in range(lists):
            before = length
            for place in range(first[i], first[i + 1]):
                if not lying[cluster[place], instances[j]]:
                    kept[length] = cluster[place]
                    length += 1
            if length - before == first[i + 1] - first[i]:
                number[i, 1 + j], length = i, before
            else:
                number[i, 1 + j] = lists + new
                origin[new], ends[new] = i, length
                new += 1
    return new, length


def leave_to_others(points: PixelLists, lying: Bool, seen: Int32, stride: int) -> PixelLists:
    """`points` without the clusters that the instance which the map has there is `lying` (N, ids + 1) on.

    `seen` holds the map's instance at every stride-th pixel of every stride-th row.
    """
    instances = np.flatnonzero(lying.any(axis=0))
    column = np.zeros(lying.shape[1], np.int32)
    column[instances] = np.arange(1, len(instances) + 1)
    lists = len(points.pixels)
    number = np.empty((lists, 1 + len(instances)), np.int32)
    origin, ends = np.empty((2, lists * len(instances)), np.int32)
    kept = np.empty(len(points.cluster) * len(instances), np.int32)
    new, length = _lists_without(points.first, points.cluster, lying, instances, number, origin, ends, kept)
    of_pixel, moved = np.empty_like(points.of_pixel), np.zeros((CHUNKS, lists + new), np.int32)
    _renumber(points.of_pixel, seen, stride, column, number, of_pixel, moved)
    pixels = moved.sum(axis=0, dtype=np.int32)
    pixels[:lists] = points.pixels
    np.subtract.at(pixels, origin[:new], pixels[lists:])
    first = np.concatenate([points.first, points.first[-1] + ends[:new]])
    return PixelLists(of_pixel, pixels, first, np.concatenate([points.cluster, kept[:length]]), points.cluster_count)
