"""Kernels of evidence_rows.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.label_evidence_kernels import (
    LATEST,
    UNBOUNDED,
    add_evidence,
    best_counted_instance,
    best_first,
    update_voxel,
)
from framework.mapping.voxels.bit_slices import ONE
from framework.mapping.voxels.integration_kernels import GROUP
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, device, one_more
from framework.mapping.voxels.voxel_walk import prefetch_line, prefetch_row

BITS = 64  # number of bits of an instance set; instance k sets bit k % BITS


@device
def _has_clusters(measurement, list_id):
    """Return True if a list of clusters is not empty."""
    return measurement.offsets[list_id] < measurement.offsets[list_id + 1]


@device
def _label(evidence, row, n, voxel, free_classes):
    """Assign empty slots to voxel n of a row."""
    evidence.labeled[row, n] = voxel
    for s in range(evidence.instance_ids.shape[1]):
        evidence.instance_ids[voxel, s] = 0
        evidence.instance_value[voxel, s] = 0
    for s in range(evidence.class_ids.shape[1]):
        evidence.class_ids[voxel, s] = free_classes[s]
        evidence.class_value[voxel, s] = 0


@device
def _prefetch_slots(evidence, voxel):
    """Prefetch the first and the last cache line of the slots of a voxel."""
    size = evidence.instance_ids.strides[0]  # compact storage has no other cache lines
    start = np.int64(voxel) * size
    prefetch_line(evidence.instance_ids, start)
    prefetch_line(evidence.instance_ids, start + size - 1)


@device
def instance_bit(instance):
    """Return the instance set with one instance."""
    return ONE << (np.uint64(instance) % np.uint64(BITS))


@njit(cache=True, nogil=True)
def find_list_bits(offsets, clusters, instance_id, list_bits):
    """Compute the instance set (L,) of each list of clusters."""
    for i in range(list_bits.shape[0]):
        list_bits[i] = 0
        for entry in range(offsets[i], offsets[i + 1]):
            list_bits[i] |= instance_bit(instance_id[clusters[entry]])


@njit(cache=True, nogil=True, parallel=True)
def update_rows(grid, seen, evidence, measurement, list_bits, row_bits, new, evicted):
    """Update the voxels near the surface that already have slots.

    Args:
        grid: The voxel grid.
        seen: The A blocks updated by the frame, and their voxels near the surface.
        evidence: The label evidence, modified in place.
        measurement: The evidence of the clusters of the frame.
        list_bits: The instance set (L,) of each list of clusters.
        row_bits: The instance set (R,) of each row, modified in place.
        new: The output (A,), the number of voxels of each block that become labeled.
        evicted: The output (A,), the number of evicted labels of each block.
    """
    list_ids = measurement.list_ids.ravel()
    blocks = seen.blocks.shape[0]
    for group in prange((blocks + GROUP - 1) // GROUP):
        labeled, lists = np.empty(BLOCK_VOXELS, np.int32), np.empty(BLOCK_VOXELS, np.int32)
        for a in range(group * GROUP, min((group + 1) * GROUP, blocks)):
            row = grid.label_row[seen.blocks[a]]
            after = grid.label_row[seen.blocks[min(a + 1, blocks - 1)]]
            if after >= 0:
                prefetch_row(evidence.labeled, np.int64(after))
            start, end = seen.near_start[a], seen.near_start[a] + seen.near_count[a]
            evictions = without_slots = count = np.int32(0)
            bits = np.uint64(0)
            for i in range(start, end):
                list_id = list_ids[seen.near_pixel[i]]
                voxel = evidence.labeled[row, seen.near_voxel[i]] if row >= 0 else np.int32(-1)
                if voxel >= 0:
                    _prefetch_slots(evidence, voxel)
                    labeled[count], lists[count] = voxel, list_id
                    count += np.int32(1)
                    bits |= list_bits[list_id]
                else:
                    without_slots = one_more(without_slots, _has_clusters(measurement, list_id))
            for i in range(count):
                evictions += update_voxel(evidence, labeled[i], measurement, lists[i])
            evicted[a], new[a] = evictions, without_slots
            if row >= 0:
                row_bits[row] |= bits


@njit(cache=True, nogil=True)
def number_new(blocks, new, row_of, row_count, voxel_count, rows, first_new):
    """Assign rows and slots to the new voxels of each block.

    Returns the number of rows and the number of labeled voxels, including the new ones.

    Args:
        blocks: The blocks (A,) updated by the frame.
        new: The number of new voxels (A,) of each block.
        row_of: The row (B,) of every block of the grid, -1 = none.
        row_count: The number of rows before the frame.
        voxel_count: The number of labeled voxels before the frame.
        rows: The output (A,), the row of each block, -1 = none.
        first_new: The output (A,), the index of the first new voxel of each block.
    """
    for a in range(blocks.shape[0]):
        rows[a], first_new[a] = row_of[blocks[a]], voxel_count
        if new[a] > 0 and rows[a] < 0:
            rows[a] = row_count
            row_count += 1
        voxel_count += new[a]
    return row_count, voxel_count


@njit(cache=True, nogil=True, parallel=True)
def label_new(grid, seen, evidence, measurement, list_bits, row_bits, new, free_classes, evicted):
    """Assign slots to the new voxels of each block, and update them.

    Args:
        grid: The voxel grid.
        seen: The A blocks updated by the frame, and their voxels near the surface.
        evidence: The label evidence, modified in place.
        measurement: The evidence of the clusters of the frame.
        list_bits: The instance set (L,) of each list of clusters.
        row_bits: The instance set (R,) of each row, modified in place.
        new: The new voxels of each block.
        free_classes: The class ids (T,) in the slots of a voxel without evidence.
        evicted: The number of evicted labels (A,) of each block, modified in place.
    """
    row_of = grid.label_row  # Numba 0.68 loses assignments to an element of a tuple's array within prange
    list_ids = measurement.list_ids.ravel()
    for a in prange(seen.blocks.shape[0]):
        voxel, row = new.starts[a], new.rows[a]
        row_of[seen.blocks[a]] = row
        start = seen.near_start[a]
        for i in range(start, start + seen.near_count[a] if new.counts[a] > 0 else start):
            list_id, n = list_ids[seen.near_pixel[i]], seen.near_voxel[i]
            if evidence.labeled[row, n] < 0 and _has_clusters(measurement, list_id):
                _label(evidence, row, n, voxel, free_classes)
                evicted[a] += update_voxel(evidence, voxel, measurement, list_id)
                row_bits[row] |= list_bits[list_id]
                voxel += np.int32(1)


@njit(cache=True, nogil=True)
def fewest_free(instance_ids):
    """Return the smallest number of free instance slots of any voxel."""
    slots = instance_ids.shape[1]
    fewest = slots
    for ids in instance_ids:
        free = 0
        while free < fewest and ids[slots - 1 - free] == 0:
            free += 1
        fewest = min(fewest, free)
    return fewest


@device
def _merge_voxel(ids, values, kept, dropped, combine):
    """Add the evidence of a voxel for instance `dropped` to its evidence for `kept`."""
    for s in range(len(ids)):
        if ids[s] == dropped:
            value = values[s]
            last = len(ids) - 1  # slots stay filled from the front
            while ids[last] == 0:
                last -= 1
            ids[s], values[s] = ids[last], values[last]
            ids[last], values[last] = 0, 0
            add_evidence(ids, values, 0, kept, value, combine, UNBOUNDED)
            best_first(ids, values, 0)
            break


@njit(cache=True, nogil=True, parallel=True)
def merge_instances(evidence, row_bits, kept, dropped, combine):
    """Merge instance `dropped` into `kept` in every voxel.

    Only the rows whose instance set (R,) may contain `dropped` are visited.
    """
    for row in prange(row_bits.shape[0]):
        if row_bits[row] & instance_bit(dropped):
            row_bits[row] |= instance_bit(kept)
            for voxel in evidence.labeled[row]:
                if voxel >= 0:
                    _merge_voxel(evidence.instance_ids[voxel], evidence.instance_value[voxel], kept, dropped, combine)


@device
def _remove_from_voxel(ids, values, removed):
    """Remove the evidence of a voxel for the instances in `removed`, and return the set of its other instances."""
    bits = np.uint64(0)
    kept = 0
    for s in range(len(ids)):
        instance, value = ids[s], values[s]
        if instance == 0:  # slots are filled from the front
            break
        k = np.searchsorted(removed, instance)
        ids[s], values[s] = 0, 0
        if k == removed.shape[0] or removed[k] != instance:
            ids[kept], values[kept] = instance, value
            bits |= instance_bit(instance)
            kept += 1
    best_first(ids, values, 0)
    return bits


@njit(cache=True, nogil=True, parallel=True)
def remove_instances(evidence, row_bits, removed):
    """Remove the evidence for the instances in `removed`, which are ascending, in every voxel.

    Only the rows whose instance set (R,) may contain one of them are visited. Their sets become exact.
    """
    removed_bits = np.uint64(0)
    for instance in removed:
        removed_bits |= instance_bit(instance)
    for row in prange(row_bits.shape[0]):
        if row_bits[row] & removed_bits:
            bits = np.uint64(0)
            for voxel in evidence.labeled[row]:
                if voxel >= 0:
                    bits |= _remove_from_voxel(evidence.instance_ids[voxel], evidence.instance_value[voxel], removed)
            row_bits[row] = bits


@njit(cache=True, nogil=True)
def sum_classes_of_instances(evidence, counts, sums):
    """Add the class scores of every labeled voxel to the sums (ids + 1, C) of its instance.

    The instance of a voxel is its most likely instance with `counts[id]` True.
    """
    for voxel in range(evidence.class_ids.shape[0]):
        instance = best_counted_instance(evidence, voxel, counts)
        for s in range(evidence.class_ids.shape[1] if instance > 0 else 0):
            label = evidence.class_ids[voxel, s]
            if label == NO_CLASS:  # slots are filled from the front
                break
            sums[instance, label - 1] += evidence.class_value[voxel, s]


@njit(cache=True, nogil=True, parallel=True)
def find_row_bits(evidence, row_bits):
    """Compute the instance set (R,) of each row."""
    for row in prange(evidence.labeled.shape[0]):
        bits = np.uint64(0)
        for voxel in evidence.labeled[row]:
            for s in range(evidence.instance_ids.shape[1] if voxel >= 0 else 0):
                instance = evidence.instance_ids[voxel, s]
                if instance == 0:  # slots are filled from the front
                    break
                bits |= instance_bit(instance)
        row_bits[row] = bits


@njit(cache=True, nogil=True, parallel=True)
def count_unlabeled(label_row, blocks, evidence, their_row, theirs, counts):
    """Count the voxels (B,) of each block that only the other evidence labels.

    Args:
        label_row: The row of every block, -1 = none.
        blocks: The block (B,) of each block of the other grid.
        evidence: The label evidence.
        their_row: The row (B,) of each block of the other grid, -1 = none.
        theirs: The other evidence.
        counts: The output.
    """
    for b in prange(blocks.shape[0]):
        row, other = label_row[blocks[b]], their_row[b]
        count = np.int32(0)
        for n in range(BLOCK_VOXELS if other >= 0 else 0):
            missing = row < 0 or evidence.labeled[max(row, 0), n] < 0
            count = one_more(count, theirs.labeled[other, n] >= 0 and missing)
        counts[b] = count


@device
def _copy_slots(evidence, voxel, theirs, other):
    """Copy the slots of a voxel of the other evidence, which has at most as many slots."""
    for s in range(evidence.instance_ids.shape[1]):
        has_slot = s < theirs.instance_ids.shape[1]
        evidence.instance_ids[voxel, s] = theirs.instance_ids[other, s] if has_slot else 0
        evidence.instance_value[voxel, s] = theirs.instance_value[other, s] if has_slot else 0
    for s in range(evidence.class_ids.shape[1]):
        evidence.class_ids[voxel, s] = theirs.class_ids[other, s]
        evidence.class_value[voxel, s] = theirs.class_value[other, s]


@device
def _add_slots(evidence, voxel, theirs, other, combine, limit):
    """Add the evidence of a voxel of the other evidence, and return the number of evicted labels."""
    evicted = 0
    ids, values = evidence.instance_ids[voxel], evidence.instance_value[voxel]
    for s in range(theirs.instance_ids.shape[1]):
        label = theirs.instance_ids[other, s]
        if label == 0:  # slots are filled from the front
            break
        evicted += add_evidence(ids, values, 0, label, theirs.instance_value[other, s], combine, UNBOUNDED)
    best_first(ids, values, 0)
    classes, scores = evidence.class_ids[voxel], evidence.class_value[voxel]
    for s in range(theirs.class_ids.shape[1]):
        label = theirs.class_ids[other, s]
        if label == NO_CLASS:
            break
        score = np.int64(theirs.class_value[other, s])  # a sum of two scores may exceed 16 bits
        evicted += add_evidence(classes, scores, NO_CLASS, label, score, combine, limit)
    best_first(classes, scores, NO_CLASS)
    return evicted


@njit(cache=True, nogil=True, parallel=True)
def add_rows(
    label_row, blocks, evidence, row_bits, their_row, theirs, their_bits, new, combine, limit, evicted
):  # fmt: skip
    """Add other evidence. If the latest label replaces all others, only the voxels without labels are changed.

    Args:
        label_row: The row of every block, -1 = none; modified in place.
        blocks: The block (B,) of each block of the other grid.
        evidence: The label evidence, modified in place.
        row_bits: The instance set (R,) of each row, modified in place.
        their_row: The row (B,) of each block of the other grid, -1 = none.
        theirs: The other evidence.
        their_bits: The instance set of each row of the other evidence.
        new: The voxels of each block that become labeled.
        combine: The rule for combining evidence, a value of Combine.
        limit: The maximum absolute class score.
        evicted: The output (B,), the number of evicted labels of each block.
    """
    # Numba 0.68 loses assignments to an element of a tuple's array within prange
    rows, starts, labeled = new.rows, new.starts, evidence.labeled
    for b in prange(blocks.shape[0]):
        other_row = their_row[b]
        if other_row < 0:
            continue
        row, voxel = rows[b], starts[b]
        label_row[blocks[b]] = row
        if row < 0:
            continue
        row_bits[row] |= their_bits[other_row]
        count = 0
        for n in range(BLOCK_VOXELS):
            other = theirs.labeled[other_row, n]
            if other < 0:
                continue
            own = labeled[row, n]
            if own < 0:
                labeled[row, n] = voxel
                _copy_slots(evidence, voxel, theirs, other)
                voxel += np.int32(1)
            elif combine != LATEST:
                count += _add_slots(evidence, own, theirs, other, combine, limit)
        evicted[b] = count
