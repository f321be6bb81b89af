"""Kernels of class_evidence.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.class_slots import ALL_NAMED, NEW_CLASSES, NO_CLASS
from framework.mapping.labels.label_evidence_kernels import best_first
from framework.mapping.voxels.voxel_grid_kernels import device

MAX_FRAMES = np.uint16(65535)  # maximum frame count of a voxel


@njit(cache=True, nogil=True)
def best_clusters(offsets, clusters, scores):
    """Return the cluster (L,) with the highest score in each list, -1 = empty list.

    Ties go to the smallest cluster index.

    Args:
        offsets: The start (L + 1,) of each list in `clusters`.
        clusters: The clusters of the lists.
        scores: The score (N,) of each cluster.
    """
    best = np.full(offsets.shape[0] - 1, -1, np.int32)
    for i in range(best.shape[0]):
        for entry in range(offsets[i], offsets[i + 1]):
            k, found = clusters[entry], best[i]
            if found < 0 or scores[k] > scores[found] or (scores[k] == scores[found] and k < found):
                best[i] = k
    return best


@device
def best_class(grid, evidence, log_missed, block, n):
    """Return the most likely class of voxel n of a block, -1 = background.

    `log_missed` is the log ratio of every class to the background for a frame outside all masks.
    """
    row = grid.label_row[block]
    if row < 0 or evidence.class_ids[row, n, 0] == NO_CLASS:
        return np.int32(-1)
    above = evidence.log_ratio[row, n, 0] + log_missed * np.float32(evidence.unmasked[block, n])
    return np.int32(evidence.class_ids[row, n, 0] - 1) if above > 0 else np.int32(-1)


@device
def _add_class(labels, sums, label, total):
    """Store a class in a free slot or in the slot of the least likely class.

    Returns 1 if a class was evicted or not stored, otherwise 0.
    """
    least = 0
    for s in range(len(labels)):
        if labels[s] == NO_CLASS:
            labels[s] = label
            sums[s] = total
            return 0
        if sums[s] < sums[least]:
            least = s
    if total > sums[least]:
        labels[least] = label
        sums[least] = total
    return 1


@device
def observe_mask(evidence, row, n, masks, k):
    """Add the evidence of mask k to voxel n of a row, and return the number of evicted classes."""
    labels, sums = evidence.class_ids[row, n], evidence.log_ratio[row, n]
    known = 0  # bits of the named classes with a slot
    for s in range(len(labels)):
        if labels[s] == NO_CLASS:
            break  # slots are filled from the front
        sums[s] += masks.log_ratio[k, labels[s] - 1]
        known |= masks.named_bit[k, labels[s]]
    evicted = 0
    for m in range(NEW_CLASSES if known != ALL_NAMED else 0):
        label = masks.named_classes[k, m]
        if m > 0 and label == masks.named_classes[k, 0]:
            break
        if not (known >> m) & 1:
            evicted += _add_class(labels, sums, label, evidence.rest[row, n] + masks.log_ratio[k, label - 1])
    evidence.rest[row, n] += masks.unnamed[k]
    best_first(labels, sums, NO_CLASS)
    if evidence.masked[row, n] < MAX_FRAMES:
        evidence.masked[row, n] += 1
    if evidence.first_frame[row, n] < 0:
        evidence.first_frame[row, n] = masks.frame
    evidence.last_frame[row, n] = masks.frame
    return evicted


@njit(cache=True, nogil=True, parallel=True)
def find_blocks_under_masks(grid, seen, cluster, wants_row):
    """Set `wants_row` (A,) to True for blocks without a row that have a voxel near the surface under a mask."""
    for a in prange(seen.blocks.shape[0]):
        wants_row[a] = False
        start = seen.near_start[a]
        if grid.label_row[seen.blocks[a]] < 0:
            for i in range(start, start + seen.near_count[a]):
                if cluster[seen.near_pixel[i]] >= 0:
                    wants_row[a] = True
                    break


@njit(cache=True, nogil=True, parallel=True)
def update_classes(grid, seen, evidence, masks, evicted):
    """Update the class evidence of the voxels near the measured surface.

    Voxels outside all masks only count the frame. The number of evicted classes of each block is written to `evicted`
    (A,).
    """
    unmasked = evidence.unmasked  # Numba 0.68 loses assignments to an element of a tuple's array within prange
    for a in prange(seen.blocks.shape[0]):
        evicted[a] = 0
        block = seen.blocks[a]
        row = grid.label_row[block]
        start = seen.near_start[a]
        for i in range(start, start + seen.near_count[a]):
            n = seen.near_voxel[i]
            k = masks.cluster[seen.near_pixel[i]]
            if k >= 0:
                evicted[a] += observe_mask(evidence, row, n, masks, k)
            elif unmasked[block, n] < MAX_FRAMES:
                unmasked[block, n] += 1
