"""Kernels of pixel_lists.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.mapping.voxels.voxel_grid_kernels import device

CHUNKS = 16  # of image rows


@device
def _are_inside(coordinates, width, height):
    """Whether all pixels (2 P,), u and v in turns, lie in the image. Unsigned, negative coordinates are large."""
    right = bottom = np.uint32(0)
    for p in range(coordinates.shape[0] // 2):
        right = max(right, np.uint32(coordinates[2 * p]))
        bottom = max(bottom, np.uint32(coordinates[2 * p + 1]))
    return right < width and bottom < height


@njit(cache=True, nogil=True)
def link_points(coordinates, cluster, of_pixel, head, rest, child, sibling, count, length):
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
def write_lists(head, rest, first, cluster):
    for i in range(first.shape[0] - 1):
        number = i
        for place in range(first[i], first[i + 1]):
            cluster[place] = head[number]
            number = rest[number]


@njit(cache=True, nogil=True)
def count_shared(pixels, first, cluster, shared):
    """Adds to shared (N, N) the pixels that each two clusters have in common, itself on the diagonal."""
    for i in range(pixels.shape[0]):
        for a in range(first[i], first[i + 1]):
            for b in range(first[i], first[i + 1]):
                shared[cluster[a], cluster[b]] += pixels[i]


@njit(cache=True, nogil=True)
def keep_smallest(pixels, first, cluster, instance_ids, share, kept_first, kept):
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


@njit(cache=True, nogil=True, parallel=True)
def renumber(of_pixel, seen, stride, column, number, renumbered, moved):
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
def lists_without(first, cluster, lying, instances, number, origin, ends, kept):
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
