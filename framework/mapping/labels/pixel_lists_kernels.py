"""Kernels of pixel_lists.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.voxel_grid_kernels import device

CHUNKS = 16  # number of chunks of image rows


@device
def _are_inside(coordinates, width, height):
    """Return True if all pixels are inside the image."""
    # coordinates alternate u and v; negative coordinates become large unsigned numbers
    right = bottom = np.uint32(0)
    for p in range(coordinates.shape[0] // 2):
        right = max(right, np.uint32(coordinates[2 * p]))
        bottom = max(bottom, np.uint32(coordinates[2 * p + 1]))
    return right < width and bottom < height


@njit(cache=True, nogil=True)
def link_points(coordinates, cluster, list_ids, tree):
    """Build the tree of lists and the list (H, W) of each pixel, and return the number of lists.

    The result is 0 if a point is outside the image.

    Args:
        coordinates: The pixels (2 P,) of the points, alternating u and v.
        cluster: The cluster (P,) of each point, negative = none.
        list_ids: The output (H, W).
        tree: The output, with a capacity of P + 1 lists.
    """
    head, parent, child, sibling, pixel_count, length = tree
    width = list_ids.shape[1]
    if not _are_inside(coordinates, width, list_ids.shape[0]):
        return np.int32(0)
    list_ids[:] = 0
    flat_ids = list_ids.ravel()
    pixel_count[0], child[0], length[0] = list_ids.size, 0, 0
    lists = np.int32(1)
    p = cluster.shape[0] - 1
    while p >= 0:  # each pass: a run of points of one cluster at pixels with the same list
        k, last = cluster[p], p
        if k < 0:
            p -= 1
            continue
        pixel = np.uint32(coordinates[2 * p + 1] * width + coordinates[2 * p])
        old = flat_ids[pixel]
        new = child[old]
        while new > 0 and head[new] != k:
            new = sibling[new]
        if new == 0:
            new = lists
            lists += np.int32(1)
            head[new], parent[new], length[new] = k, old, length[old] + 1
            pixel_count[new], child[new] = 0, 0
            child[old], sibling[new] = new, child[old]
        while True:
            flat_ids[pixel] = new
            p -= 1
            if p < 0 or cluster[p] != k:
                break
            pixel = np.uint32(coordinates[2 * p + 1] * width + coordinates[2 * p])
            if flat_ids[pixel] != old:
                break
        pixel_count[old] -= last - p
        pixel_count[new] += last - p
    return lists


@njit(cache=True, nogil=True)
def write_lists(head, parent, offsets, clusters):
    """Write the clusters of each list to the flat array `clusters`."""
    for i in range(offsets.shape[0] - 1):
        list_id = i
        for entry in range(offsets[i], offsets[i + 1]):
            clusters[entry] = head[list_id]
            list_id = parent[list_id]


@njit(cache=True, nogil=True)
def keep_smallest(pixel_counts, offsets, clusters, instance_ids, area_ratio, kept_offsets, kept):
    """Remove from each list the clusters without an instance and those much larger than its smallest cluster.

    The reduced lists are written to `kept_offsets` (L + 1,) and `kept`. The other arguments are those of keep_on_top().
    """
    sizes = np.zeros(instance_ids.shape[0], np.float64)
    for i in range(pixel_counts.shape[0]):
        for entry in range(offsets[i], offsets[i + 1]):
            sizes[clusters[entry]] += pixel_counts[i]
    n = 0
    for i in range(pixel_counts.shape[0]):
        kept_offsets[i] = n
        smallest = np.float64(np.inf)
        for entry in range(offsets[i], offsets[i + 1]):
            if instance_ids[clusters[entry]] > 0:
                smallest = min(smallest, sizes[clusters[entry]])
        for entry in range(offsets[i], offsets[i + 1]):
            k = clusters[entry]
            if instance_ids[k] > 0 and smallest >= area_ratio * sizes[k]:
                kept[n] = k
                n += 1
    kept_offsets[pixel_counts.shape[0]] = n


@device
def _column(instances, instance):
    """Return 1 plus the position of an instance in `instances`, which are ascending, 0 = none."""
    k = np.searchsorted(instances, instance)
    return k + 1 if k < instances.shape[0] and instances[k] == instance else 0


@njit(cache=True, nogil=True, parallel=True)
def relabel(list_ids, seen, stride, instances, replacement, new_ids, moved):
    """Replace the list of each pixel, depending on the instance of the map at this pixel.

    Args:
        list_ids: The list (H, W) of each pixel.
        seen: The instance at every stride-th pixel of every stride-th row, 0 = none.
        stride: The distance between the samples in `seen`, px.
        instances: The instances (J,) with a replacement, ascending.
        replacement: The new list (L, 1 + J) for each list and instance.
        new_ids: The output (H, W).
        moved: The number of pixels (CHUNKS, lists) that get each new list, modified in place.
    """
    height, width = list_ids.shape
    for chunk in prange(CHUNKS):
        for v in range(chunk * height // CHUNKS, (chunk + 1) * height // CHUNKS):
            row, old_row, new_row = seen[v // stride], list_ids[v], new_ids[v]
            new_row[:] = old_row
            instance, k = np.int32(0), 0
            for sample in range(row.shape[0]):
                if row[sample] != instance:
                    instance = row[sample]
                    k = _column(instances, instance)
                for u in range(sample * stride, min((sample + 1) * stride, width) if k > 0 else 0):
                    old = old_row[u]
                    new = replacement[old, k]
                    new_row[u] = new
                    if new != old:
                        moved[chunk, new] += 1


@njit(cache=True, nogil=True)
def lists_without(offsets, clusters, supported, replacement, origin, ends, kept):
    """Create the lists that replace others at the pixels of supported instances.

    Returns the number of new lists and the number of their clusters.

    Args:
        offsets: The start (L + 1,) of each list in `clusters`.
        clusters: The clusters of the lists.
        supported: A Boolean array (N, J), True where the object of a cluster supports an instance.
        replacement: The output (L, 1 + J), the new list for each list and instance. Column 0 is for other pixels.
        origin: The output, the list that each new list replaces.
        ends: The output, the end of each new list in `kept`.
        kept: The output, the clusters of the new lists.
    """
    lists = offsets.shape[0] - 1
    new = length = 0
    for i in range(lists):
        replacement[i, 0] = i
    for j in range(supported.shape[1]):
        for i in range(lists):
            before = length
            for entry in range(offsets[i], offsets[i + 1]):
                if not supported[clusters[entry], j]:
                    kept[length] = clusters[entry]
                    length += 1
            if length - before == offsets[i + 1] - offsets[i]:
                replacement[i, 1 + j], length = i, before
            else:
                replacement[i, 1 + j] = lists + new
                origin[new], ends[new] = i, length
                new += 1
    return new, length
