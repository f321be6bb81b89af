"""Kernels of segment_owners.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Int32


@njit(cache=True, nogil=True)
def find_owners(pixels: Int32, cluster: Int32, clusters: int, labels: Int32, count: int, min_overlap: float) -> Int32:
    """Return the cluster (count,) with the most points in each segment, -1 = none.

    Ties go to the first cluster.

    Args:
        pixels: The pixels (P, 2), u and v, of the points.
        cluster: The cluster (P,) of each point, -1 = none.
        clusters: The number of clusters.
        labels: The segment (H, W) of each pixel, -1 = none.
        count: The number of segments.
        min_overlap: The minimum fraction of the segment that the points must cover.
    """
    sizes, covered = np.zeros(count, np.int64), np.zeros((count, clusters), np.int64)
    for label in labels.ravel():
        if label >= 0:
            sizes[label] += 1
    for i in range(len(cluster)):
        label = labels[pixels[i, 1], pixels[i, 0]]
        if label >= 0 and cluster[i] >= 0:
            covered[label, cluster[i]] += 1
    owners = np.full(count, -1, np.int32)
    for s in range(count):
        best = np.argmax(covered[s])
        if covered[s, best] > min_overlap * sizes[s]:
            owners[s] = best
    return owners


@njit(cache=True, nogil=True)
def judged(pixels: Int32, cluster: Int32, labels: Int32, owners: Int32) -> tuple[Bool, Int32, Int32]:
    """Find the points to keep, and the pixels of segments that are not covered by their cluster.

    Points are kept if their cluster owns their segment, or if they belong to no cluster.

    Args:
        pixels: The pixels (P, 2), u and v, of the points.
        cluster: The cluster (P,) of each point, -1 = none.
        labels: The segment (H, W) of each pixel, -1 = none.
        owners: The cluster that owns each segment, -1 = none.

    Returns:
        A Boolean array (P,), True for points to keep.
        The uncovered pixels (A, 2), u and v, of owned segments.
        The owner (A,) of each uncovered pixel.
    """
    height, width = labels.shape
    kept, covered = np.ones(len(cluster), np.bool_), np.zeros(labels.shape, np.bool_)
    for i in range(len(cluster)):
        u, v = pixels[i, 0], pixels[i, 1]
        if cluster[i] >= 0:
            kept[i] = labels[v, u] >= 0 and owners[labels[v, u]] == cluster[i]
            covered[v, u] |= kept[i]
    count = 0
    for v in range(height):
        for u in range(width):
            covered[v, u] |= labels[v, u] < 0 or owners[labels[v, u]] < 0
            count += not covered[v, u]
    missing, owner = np.empty((count, 2), np.int32), np.empty(count, np.int32)
    count = 0
    for v in range(height):
        for u in range(width):
            if not covered[v, u]:
                missing[count, 0], missing[count, 1] = u, v
                owner[count] = owners[labels[v, u]]
                count += 1
    return kept, missing, owner
