"""Kernels of packed_evidence.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.evidence_rows_kernels import instance_bit
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS, device

GROUP = 64  # number of rows that share scratch arrays
TABLE_BITS = 10  # the hash table of a block has twice as many entries as the block has voxels
SHIFT = np.uint64(64 - TABLE_BITS)
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)


@device
def _hash(ids, values, classes, scores):
    """Return the first entry of a hash table to probe for the slots of a voxel."""
    mixed = np.uint64(0)
    for s in range(len(ids)):
        mixed = (mixed ^ np.uint64(ids[s])) * MULTIPLIER
        mixed = (mixed ^ np.uint64(values[s])) * MULTIPLIER
    for s in range(len(classes)):
        mixed = (mixed ^ (np.uint64(scores[s]) << np.uint64(16) | np.uint64(classes[s]))) * MULTIPLIER
        mixed ^= mixed >> np.uint64(32)
    return np.int64(mixed >> SHIFT)


@device
def _equal(a, b):
    """Return True if two arrays have equal elements."""
    equal = True
    for s in range(len(a)):
        equal &= a[s] == b[s]
    return equal


@device
def _used(labels, free):
    """Return the number of used slots."""
    count = len(labels)
    while count > 0 and labels[count - 1] == free:  # slots are filled from the front
        count -= 1
    return count


@njit(cache=True, nogil=True, parallel=True)
def mark_labeled(labeled, words):
    """Write the labeled voxels (R, 512) as bits (R, 8)."""
    for row in prange(len(words)):
        for z in range(BLOCK_SIDE):
            found = np.uint64(0)
            for n in range(64):
                found |= np.uint64(labeled[row, 64 * z + n] >= 0) << np.uint64(n)
            words[row, z] = found


@njit(cache=True, nogil=True, parallel=True)
def find_states(evidence, values, starts, states, counts):
    """Number the distinct states of the labeled voxels of each row, in the order of their first voxels.

    Args:
        evidence: The label evidence.
        values: The bits (L, S) of evidence.instance_value.
        starts: The index (R,) of the first labeled voxel of each row.
        states: The output (L,), the state of each labeled voxel in its row, in the order of the voxels.
        counts: The output (3, R), the number of states, of their used instance slots and of their used class slots.
    """
    labeled = evidence.labeled
    ids, classes, scores = evidence.instance_ids, evidence.class_ids, evidence.class_value
    rows = len(starts)
    for group in prange((rows + GROUP - 1) // GROUP):
        table = np.empty(1 << TABLE_BITS, np.int32)
        firsts = np.empty(BLOCK_VOXELS, np.int32)  # first voxel of each state
        for row in range(group * GROUP, min((group + 1) * GROUP, rows)):
            table[:] = -1
            found = of_instances = of_classes = 0
            at = starts[row]
            for n in range(BLOCK_VOXELS):
                voxel = labeled[row, n]
                if voxel < 0:
                    continue
                entry = _hash(ids[voxel], values[voxel], classes[voxel], scores[voxel])
                while table[entry] >= 0:
                    first = firsts[table[entry]]
                    if (
                        _equal(classes[first], classes[voxel])
                        and _equal(scores[first], scores[voxel])
                        and _equal(ids[first], ids[voxel])
                        and _equal(values[first], values[voxel])
                    ):
                        break
                    entry = (entry + 1) & ((1 << TABLE_BITS) - 1)
                if table[entry] < 0:
                    table[entry] = found
                    firsts[found] = voxel
                    found += 1
                    of_instances += _used(ids[voxel], 0)
                    of_classes += _used(classes[voxel], NO_CLASS)
                states[at] = table[entry]
                at += 1
            counts[0, row], counts[1, row], counts[2, row] = found, of_instances, of_classes


@njit(cache=True, nogil=True, parallel=True)
def write_states(evidence, starts, first, packed):
    """Write the used slots of the distinct states.

    Args:
        evidence: The label evidence.
        starts: The index (R,) of the first labeled voxel of each row.
        first: The index (3, R) of the first state, instance slot and class slot of each row.
        packed: The output. Its states are known.
    """
    labeled = evidence.labeled
    ids, classes, scores = evidence.instance_ids, evidence.class_ids, evidence.class_value
    # Numba 0.68 loses assignments to an element of a tuple's array within prange
    instance_slots, class_slots = packed.instance_slots, packed.class_slots
    instance_ids, instance_value = packed.instance_ids, packed.instance_value
    class_ids, class_value = packed.class_ids, packed.class_value
    for row in prange(len(starts)):
        at, found = starts[row], 0
        state, i, c = first[0, row], first[1, row], first[2, row]
        for n in range(BLOCK_VOXELS):
            voxel = labeled[row, n]
            if voxel < 0:
                continue
            if packed.states[at] == found:
                of_instances = _used(ids[voxel], 0)
                of_classes = _used(classes[voxel], NO_CLASS)
                instance_slots[state] = of_instances
                class_slots[state] = of_classes
                for s in range(of_instances):
                    instance_ids[i + s] = ids[voxel, s]
                    instance_value[i + s] = evidence.instance_value[voxel, s]
                for s in range(of_classes):
                    class_ids[c + s] = classes[voxel, s]
                    class_value[c + s] = scores[voxel, s]
                found, state, i, c = found + 1, state + 1, i + of_instances, c + of_classes
            at += 1


@njit(cache=True, nogil=True)
def find_wrong_state(starts, states, counts):
    """Return the first row with a state that is not less than its number of states (R,), -1 = none."""
    for row in range(len(counts)):
        for at in range(starts[row], starts[row + 1]):
            if states[at] >= counts[row]:
                return row
    return -1


@njit(cache=True, nogil=True, parallel=True)
def read_states(packed, starts, first, free_classes, evidence, row_bits):
    """Write the slots of all labeled voxels, which are numbered in the order of the rows and of their voxels.

    Args:
        packed: The packed evidence.
        starts: The index (R,) of the first labeled voxel of each row.
        first: The index (3, R) of the first state, instance slot and class slot of each row.
        free_classes: The class ids (T,) in the slots of a voxel without evidence.
        evidence: The label evidence, modified in place.
        row_bits: The output (R,), the instance set of each row.
    """
    labeled = evidence.labeled
    ids, values = evidence.instance_ids, evidence.instance_value
    classes, scores = evidence.class_ids, evidence.class_value
    for row in prange(len(starts)):
        of_instances = np.empty(BLOCK_VOXELS + 1, np.int64)  # first slots of each state
        of_classes = np.empty(BLOCK_VOXELS + 1, np.int64)
        of_instances[0], of_classes[0] = first[1, row], first[2, row]
        for s in range(packed.state_counts[row]):
            of_instances[s + 1] = of_instances[s] + packed.instance_slots[first[0, row] + s]
            of_classes[s + 1] = of_classes[s] + packed.class_slots[first[0, row] + s]
        labeled[row] = -1
        bits = np.uint64(0)
        voxel = starts[row]
        for z in range(BLOCK_SIDE):
            left = packed.labeled[row, z]
            while left:
                labeled[row, 64 * z + lowest_bit(left)] = voxel
                left &= left - ONE
                state = packed.states[voxel]
                start, used = of_instances[state], of_instances[state + 1] - of_instances[state]
                for s in range(ids.shape[1]):
                    ids[voxel, s] = packed.instance_ids[start + s] if s < used else 0
                    values[voxel, s] = packed.instance_value[start + s] if s < used else 0
                    bits |= instance_bit(ids[voxel, s])
                start, used = of_classes[state], of_classes[state + 1] - of_classes[state]
                for s in range(classes.shape[1]):
                    classes[voxel, s] = packed.class_ids[start + s] if s < used else free_classes[s]
                    scores[voxel, s] = packed.class_value[start + s] if s < used else 0
                voxel += 1
        row_bits[row] = bits
