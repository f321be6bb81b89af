"""Pixel lists: the clusters at each pixel of overlapping masks.

Only a few different combinations of clusters occur. Each combination is one list, and each pixel stores the index of
its list. The example has two overlapping masks of clusters 0 and 1 (* = both):

    masks        list_ids (H, W)      list   clusters    offsets     clusters array
    0 0 .        1 1 0                0      none        0           [0, 0, 1, 1]
    0 * 1        1 2 3                1      0           0
    . 1 1        0 3 3                2      0, 1        1
                                      3      1           3           offsets[4] = 4

The pixel counts of the lists give the sizes of the clusters, which determine the occlusion order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Bool, Int32, PointClusters
from framework.geometry import require_pixels_inside
from framework.mapping.labels.pixel_lists_kernels import (
    CHUNKS,
    keep_smallest,
    link_points,
    lists_without,
    relabel,
    write_lists,
)


class PixelLists(NamedTuple):
    """The L lists of clusters of an image.

    List i contains clusters[offsets[i] : offsets[i + 1]].
    """

    list_ids: Int32  # (H, W) list of each pixel; list 0 is empty
    pixel_counts: Int32  # (L,) number of pixels of each list
    offsets: Int32  # (L + 1,) start of each list in `clusters`
    clusters: Int32  # (offsets[L],) clusters of all lists; within a list, in the order of the points
    cluster_count: int  # number of clusters, N


class ListTree(NamedTuple):
    """Tree of lists under construction.

    A list consists of one cluster, its head, and the clusters of its parent list.
    """

    head: Int32  # (capacity,) head of each list
    parent: Int32  # (capacity,) parent of each list
    child: Int32  # (capacity,) most recent list with this parent, 0 = none
    sibling: Int32  # (capacity,) previous list with the same parent, 0 = none
    pixel_count: Int32  # (capacity,) number of pixels of each list
    length: Int32  # (capacity,) number of clusters of each list


def list_points_by_pixel(clusters: PointClusters, shape: tuple[int, int]) -> PixelLists:
    """Return the clusters at each pixel of an image.

    Args:
        clusters: The clusters, with the pixels of their points.
        shape: The height and width of the image.

    Raises:
        DataError: If a pixel is outside the image.
    """
    list_ids = np.empty(shape, np.int32)
    capacity = len(clusters.cluster) + 1
    tree = ListTree(*(np.empty(capacity, np.int32) for _ in ListTree._fields))
    lists = link_points(clusters.pixels.ravel(), clusters.cluster, list_ids, tree)
    if lists == 0:
        require_pixels_inside(clusters, shape)
    pixel_counts = tree.pixel_count[:lists].copy()
    lengths = np.where(pixel_counts > 0, tree.length[:lists], 0)
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    listed = np.empty(offsets[-1], np.int32)
    write_lists(tree.head, tree.parent, offsets, listed)
    return PixelLists(list_ids, pixel_counts, offsets, listed, len(clusters))


def keep_on_top(points: PixelLists, instance_ids: Int32, area_ratio: float) -> PixelLists:
    """Remove clusters without an instance, and clusters that are much larger than another cluster at the same pixel.

    Large masks are coarse and cover small objects, such as a book on a couch.

    Args:
        points: The lists of clusters at the pixels.
        instance_ids: The instance (N,) of each cluster, 0 = none.
        area_ratio: The minimum ratio of the area of the smallest cluster at a pixel to that of any other kept cluster.
    """
    offsets, kept = np.empty_like(points.offsets), np.empty_like(points.clusters)
    keep_smallest(points.pixel_counts, points.offsets, points.clusters, instance_ids, area_ratio, offsets, kept)
    return points._replace(offsets=offsets, clusters=kept[: offsets[-1]])


def remove_supports(points: PixelLists, supported: Bool, instance_ids: Int32, seen: Int32, stride: int) -> PixelLists:
    """Remove each cluster from the pixels of the instances that its object supports.

    Args:
        points: The lists of clusters at the pixels.
        supported: A Boolean array (N, M), True where the object of a cluster supports an instance.
        instance_ids: The instances (M,), ascending.
        seen: The instance of the map at every stride-th pixel of every stride-th row, 0 = none.
        stride: The distance between the samples in `seen`, px.
    """
    is_supported = supported.any(axis=0)
    supported, instances = np.ascontiguousarray(supported[:, is_supported]), instance_ids[is_supported]
    lists = len(points.pixel_counts)
    replacement = np.empty((lists, 1 + len(instances)), np.int32)
    origin, ends = np.empty((2, lists * len(instances)), np.int32)
    kept = np.empty(len(points.clusters) * len(instances), np.int32)
    new, length = lists_without(points.offsets, points.clusters, supported, replacement, origin, ends, kept)
    list_ids, moved = np.empty_like(points.list_ids), np.zeros((CHUNKS, lists + new), np.int32)
    relabel(points.list_ids, seen, stride, instances, replacement, list_ids, moved)
    pixel_counts = moved.sum(axis=0, dtype=np.int32)
    pixel_counts[:lists] = points.pixel_counts
    np.subtract.at(pixel_counts, origin[:new], pixel_counts[lists:])
    offsets = np.concatenate([points.offsets, points.offsets[-1] + ends[:new]])
    clusters = np.concatenate([points.clusters, kept[:length]])
    return PixelLists(list_ids, pixel_counts, offsets, clusters, points.cluster_count)
