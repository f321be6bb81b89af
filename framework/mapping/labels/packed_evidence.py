"""Label evidence in map files.

Nearby voxels often have equal evidence, because the same clusters have updated them. A file contains each distinct
state once per block, and only its used slots. The voxels are numbered in the order of the rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from framework.data import Float32, Int32, Int64, UInt16, check_array
from framework.errors import DataError
from framework.mapping.labels.class_slots import ClassIds
from framework.mapping.labels.label_evidence import Evidence, Integers
from framework.mapping.labels.packed_evidence_kernels import (
    find_states,
    find_wrong_state,
    mark_labeled,
    read_states,
    write_states,
)
from framework.mapping.voxels.packed_voxels import Bits, starts_of
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS


class PackedEvidence(NamedTuple):
    """The evidence of the L labeled voxels in R rows, which have K distinct states."""

    labeled: Bits  # (R, 8) labeled voxels; bit n of word z represents voxel 64 z + n of a block
    states: UInt16  # (L,) state of each voxel, counted in its row
    state_counts: UInt16  # (R,) number of states of each row, whose sum is K
    instance_slots: UInt16  # (K,) number of used instance slots of each state
    class_slots: UInt16  # (K,) number of used class slots of each state
    instance_ids: Int32  # (sum of instance_slots,)
    instance_value: Float32  # (sum of instance_slots,)
    class_ids: ClassIds  # (sum of class_slots,)
    class_value: Integers  # (sum of class_slots,)


def pack_evidence(evidence: Evidence) -> PackedEvidence:
    """Return the evidence without duplicates and free slots."""
    rows = len(evidence.labeled)
    labeled, counts = np.empty((rows, BLOCK_SIDE), np.uint64), np.empty((3, rows), np.int64)
    mark_labeled(evidence.labeled, labeled)
    starts = starts_of(labeled)
    states = np.empty(starts[-1], np.uint16)
    values = evidence.instance_value.view(np.int32)  # the bits, so that 0.0 and -0.0 differ
    find_states(evidence, values, starts[:-1], states, counts)
    k, i, c = counts.sum(axis=1).tolist()
    packed = PackedEvidence(
        labeled=labeled,
        states=states,
        state_counts=counts[0].astype(np.uint16),
        instance_slots=np.empty(k, np.uint16),
        class_slots=np.empty(k, np.uint16),
        instance_ids=np.empty(i, np.int32),
        instance_value=np.empty(i, np.float32),
        class_ids=np.empty(c, evidence.class_ids.dtype),
        class_value=np.empty(c, evidence.class_value.dtype),
    )
    write_states(evidence, starts[:-1], np.cumsum(counts, axis=1) - counts, packed)
    return packed


def unpack_evidence(packed: PackedEvidence, free_classes: ClassIds, evidence: Evidence, row_bits: Bits) -> None:
    """Write packed evidence to the slots of its voxels.

    Args:
        packed: The packed evidence.
        free_classes: The class ids (T,) in the slots of a voxel without evidence.
        evidence: The output, with R rows and L labeled voxels.
        row_bits: The output (R,), the instance set of each row.
    """
    ends = np.cumsum(packed.state_counts, dtype=np.int64)
    first_states = ends - packed.state_counts
    first = np.stack([first_states, *(_before(slots)[first_states] for slots in packed[3:5])])
    read_states(packed, starts_of(packed.labeled)[:-1], first, free_classes, evidence, row_bits)


def checked_evidence(arrays: dict[str, Any], like: Evidence, instance_slots: int) -> PackedEvidence:
    """Return the evidence in the arrays of a map file.

    Args:
        arrays: The arrays of the file.
        like: The evidence of an empty map of the same kind.
        instance_slots: The maximum number of instance slots of a voxel.

    Raises:
        DataError: If an array has the wrong type or length, or invalid values.
    """
    packed = PackedEvidence(**{name: arrays[name] for name in PackedEvidence._fields})
    check_array("labeled", packed.labeled, (None, BLOCK_SIDE), np.uint64)
    starts = starts_of(packed.labeled)
    check_array("states", packed.states, (int(starts[-1]),), np.uint16)
    check_array("state_counts", packed.state_counts, (len(packed.labeled),), np.uint16)
    count = int(packed.state_counts.sum(dtype=np.int64))
    for name, low, high in (
        ("state_counts", 0, BLOCK_VOXELS),
        ("instance_slots", 0, instance_slots),
        ("class_slots", 1, like.class_ids.shape[1]),
    ):
        numbers = arrays[name]
        if name != "state_counts":
            check_array(name, numbers, (count,), np.uint16)
        if len(numbers) and not low <= numbers.min() <= numbers.max() <= high:
            raise DataError(f"{name}: expected numbers in [{low}, {high}], got {numbers.min()} to {numbers.max()}")
    row = find_wrong_state(starts, packed.states, packed.state_counts)
    if row >= 0:
        found = packed.states[starts[row] : starts[row + 1]].max()
        raise DataError(f"states: expected less than {packed.state_counts[row]} in row {row}, got {found}")
    for slots, names in (
        (packed.instance_slots, ("instance_ids", "instance_value")),
        (packed.class_slots, ("class_ids", "class_value")),
    ):
        for name in names:
            check_array(name, arrays[name], (int(slots.sum(dtype=np.int64)),), getattr(like, name).dtype)
    return packed


def _before(counts: UInt16) -> Int64:
    """Return the sums (K + 1,) of the counts (K,) before each entry, and of all counts."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts, dtype=np.int64)])
