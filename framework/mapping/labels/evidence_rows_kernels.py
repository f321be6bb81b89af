"""Kernels of evidence_rows.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.mapping.labels.label_evidence_kernels import UNBOUNDED, add_evidence, best_first, update_voxel
from framework.mapping.voxels.bit_slices import ONE
from framework.mapping.voxels.integration_kernels import GROUP
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, device, one_more
from framework.mapping.voxels.voxel_walk import prefetch_line, prefetch_row

BITS = 64  # of a word that tells which instances a row may know: instance k is bit k % BITS


@device
def _is_named(measurement, number):
    """Whether the list of clusters with that number has any."""
    return measurement.first[number] < measurement.first[number + 1]


@device
def _label(evidence, row, n, voxel, free_classes):
    """Gives voxel n of a row the slots of number `voxel`."""
    evidence.labeled[row, n] = voxel
    for s in range(evidence.instance_ids.shape[1]):
        evidence.instance_ids[voxel, s] = 0
        evidence.instance_value[voxel, s] = 0
    for s in range(evidence.class_ids.shape[1]):
        evidence.class_ids[voxel, s] = free_classes[s]
        evidence.class_value[voxel, s] = 0


@device
def _ask_for_slots(evidence, voxel):
    """Has a labelled voxel's slots loaded while the processor goes on: in compact storage all of them."""
    size = evidence.instance_ids.strides[0]
    first = np.int64(voxel) * size
    prefetch_line(evidence.instance_ids, first)
    prefetch_line(evidence.instance_ids, first + size - 1)


@device
def _instance_bit(instance):
    return ONE << (np.uint64(instance) % np.uint64(BITS))


@njit(cache=True, nogil=True)
def find_named(first, cluster, instance_id, named):
    """Fills named (L,) with the bits of the instances of each list's clusters."""
    for i in range(named.shape[0]):
        named[i] = 0
        for place in range(first[i], first[i + 1]):
            named[i] |= _instance_bit(instance_id[cluster[place]])


@njit(cache=True, nogil=True, parallel=True)
def update_rows(grid, seen, evidence, measurement, of_pixel, named, known, new, evicted):
    """Updates the near voxels of the seen blocks that have slots.

    Adds to a row's instances, known (R,), those that are named (L,) in the lists of its voxels' pixels. Counts in
    new (A,) those without that lie under a cluster with an instance, in evicted (A,) slots given away.
    """
    blocks = seen.blocks.shape[0]
    for group in prange((blocks + GROUP - 1) // GROUP):
        voxels, numbers = np.empty(BLOCK_VOXELS, np.int32), np.empty(BLOCK_VOXELS, np.int32)
        for a in range(group * GROUP, min((group + 1) * GROUP, blocks)):
            row = grid.label_row[seen.blocks[a]]
            after = grid.label_row[seen.blocks[min(a + 1, blocks - 1)]]
            if after >= 0:
                prefetch_row(evidence.labeled, np.int64(after))
            first, last = seen.near_first[a], seen.near_first[a] + seen.near_count[a]
            given_away = without_slots = count = np.int32(0)
            more = np.uint64(0)
            for i in range(first, last):
                number = of_pixel[seen.near_pixel[i]]
                voxel = evidence.labeled[row, seen.near_voxel[i]] if row >= 0 else np.int32(-1)
                if voxel >= 0:
                    _ask_for_slots(evidence, voxel)
                    voxels[count], numbers[count] = voxel, number
                    count += np.int32(1)
                    more |= named[number]
                else:
                    without_slots = one_more(without_slots, _is_named(measurement, number))
            for i in range(count):
                given_away += update_voxel(evidence, voxels[i], measurement, numbers[i])
            evicted[a], new[a] = given_away, without_slots
            if row >= 0:
                known[row] |= more


@njit(cache=True, nogil=True)
def number_new(blocks, new, row_of, row_count, voxel_count, rows, first_new):
    """Fills rows (A,) with the row of each block, a new one where it has new (A,) voxels and none, and first_new (A,)
    with the number of the first of these; returns how many rows and voxels there are then.
    """
    for a in range(blocks.shape[0]):
        rows[a], first_new[a] = row_of[blocks[a]], voxel_count
        if new[a] > 0 and rows[a] < 0:
            rows[a] = row_count
            row_count += 1
        voxel_count += new[a]
    return row_count, voxel_count


@njit(cache=True, nogil=True, parallel=True)
def label_new(grid, seen, evidence, measurement, of_pixel, named, known, new, rows, first_new, free_classes, evicted):
    """Gives the new (A,) voxels of each block, in its row, their slots, from first_new (A,) on, and updates them like
    _update().

    free_classes (T,) is what slots for classes hold before; slots given away are added to evicted (A,).
    """
    row_of = grid.label_row  # numba 0.68 loses what is assigned to an element of a tuple's array within prange
    for a in prange(seen.blocks.shape[0]):
        voxel, row = first_new[a], rows[a]
        row_of[seen.blocks[a]] = row
        first = seen.near_first[a]
        for i in range(first, first + seen.near_count[a] if new[a] > 0 else first):
            number, n = of_pixel[seen.near_pixel[i]], seen.near_voxel[i]
            if evidence.labeled[row, n] < 0 and _is_named(measurement, number):
                _label(evidence, row, n, voxel, free_classes)
                evicted[a] += update_voxel(evidence, voxel, measurement, number)
                known[row] |= named[number]
                voxel += np.int32(1)


@njit(cache=True, nogil=True)
def fewest_free(instance_ids):
    """The free slots of the voxel that has fewest of them, of instance_ids (L, S)."""
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
    """Gives what a voxel's slots hold for instance `dropped`, if anything, to `kept`."""
    for s in range(len(ids)):
        if ids[s] == dropped:
            gain = values[s]
            last = len(ids) - 1  # slots stay filled from the front
            while ids[last] == 0:
                last -= 1
            ids[s], values[s] = ids[last], values[last]
            ids[last], values[last] = 0, 0
            add_evidence(ids, values, 0, kept, gain, combine, UNBOUNDED)
            best_first(ids, values, 0)
            break


@njit(cache=True, nogil=True, parallel=True)
def merge_instances(evidence, known, kept, dropped, combine):
    """Merges in the rows that may know the dropped instance, of known (R,), which then may know the other one."""
    for row in prange(known.shape[0]):
        if known[row] & _instance_bit(dropped):
            known[row] |= _instance_bit(kept)
            for voxel in evidence.labeled[row]:
                if voxel >= 0:
                    _merge_voxel(evidence.instance_ids[voxel], evidence.instance_value[voxel], kept, dropped, combine)
