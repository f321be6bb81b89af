"""The clusters over each pixel: masks overlap, and a pixel may lie under several.

Pixels lie under few different combinations of clusters. Each combination is a list with a number, and an image has the
number of each pixel's list, so that what concerns lists costs next to nothing. What clusters share decides which of two
is the same object found twice, and which of two lies on top of the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Bool, Float32, Int32, PointClusters
from framework.geometry import require_pixels_inside
from framework.mapping.labels.pixel_lists_kernels import (
    CHUNKS,
    count_shared,
    keep_smallest,
    link_points,
    lists_without,
    renumber,
    write_lists,
)


class PixelLists(NamedTuple):
    """The clusters over each pixel, of N, as L lists: those of list i are cluster[first[i] : first[i + 1]]."""

    of_pixel: Int32  # (H, W) the number of each pixel's list; list 0 is empty
    pixels: Int32  # (L,) how many pixels have each list
    first: Int32  # (L + 1,)
    cluster: Int32  # (first[L],) in the order of the points
    cluster_count: int  # N


def list_points_by_pixel(clusters: PointClusters, shape: tuple[int, int]) -> PixelLists:
    """The clusters over each pixel of the (height, width) image, by the points that were seen there.

    Lists that no pixel has are empty.

    Raises DataError when a pixel lies outside the image.
    """
    of_pixel = np.empty(shape, np.int32)
    room = len(clusters.cluster) + 1
    head, rest, child, sibling, count, length = (np.empty(room, np.int32) for _ in range(6))
    lists = link_points(clusters.pixels.ravel(), clusters.cluster, of_pixel, head, rest, child, sibling, count, length)
    if lists == 0:
        require_pixels_inside(clusters, shape)
    count = count[:lists].copy()
    first = _begins(np.where(count > 0, length[:lists], 0))
    cluster = np.empty(first[-1], np.int32)
    write_lists(head, rest, first, cluster)
    return PixelLists(of_pixel, count, first, cluster, len(clusters))


def _begins(lengths: Int32) -> Int32:
    """(L + 1,) where lists of so many clusters begin, one behind the other, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


def cover_another(points: PixelLists, scores: Float32, threshold: float) -> Bool:
    """(N,) clusters that share more than `threshold` of the smaller one's pixels with a cluster of a better score.

    Such a cluster is most likely the same object found twice and must not become an instance of its own.
    """
    n = points.cluster_count
    shared = np.zeros((n, n), np.int32)
    count_shared(points.pixels, points.first, points.cluster, shared)
    sizes = shared.diagonal()
    over_smaller = shared / np.maximum(np.minimum(sizes[:, None], sizes[None, :]), 1)
    rank = np.lexsort((np.arange(n), -scores)).argsort()
    better = rank[None, :] < rank[:, None]
    return np.asarray((better & (over_smaller > threshold)).any(axis=1))


def keep_on_top(points: PixelLists, instance_ids: Int32, share: float) -> PixelLists:
    """Only the clusters with an instance (`instance_ids` (N,), 0 = none), of which small ones have for themselves what
    large ones claim as well.

    A network draws a large mask coarsely, over the small thing that lies on the object: a book on a couch. Under
    overlapping clusters a pixel is left to those that are not more than 1 / `share` times as large as the smallest
    there; with share 0 to all.
    """
    first, kept = np.empty_like(points.first), np.empty_like(points.cluster)
    keep_smallest(points.pixels, points.first, points.cluster, instance_ids, share, first, kept)
    return points._replace(first=first, cluster=kept[: first[-1]])


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
    new, length = lists_without(points.first, points.cluster, lying, instances, number, origin, ends, kept)
    of_pixel, moved = np.empty_like(points.of_pixel), np.zeros((CHUNKS, lists + new), np.int32)
    renumber(points.of_pixel, seen, stride, column, number, of_pixel, moved)
    pixels = moved.sum(axis=0, dtype=np.int32)
    pixels[:lists] = points.pixels
    np.subtract.at(pixels, origin[:new], pixels[lists:])
    first = np.concatenate([points.first, points.first[-1] + ends[:new]])
    return PixelLists(of_pixel, pixels, first, np.concatenate([points.cluster, kept[:length]]), points.cluster_count)
