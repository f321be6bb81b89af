"""Storage and update of the label evidence.

In compact storage, the slots of a labeled voxel take 80 bytes (96 for more than 255 classes), and a row of a block
takes 2 KiB. A voxel becomes labeled when it is near the measured surface and its pixel is inside a mask.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from framework.data import Bool, Float64, Int32
from framework.mapping.labels.class_slots import CLASS_SLOTS, NO_CLASS, ClassIds, class_id_type
from framework.mapping.labels.evidence_rows_kernels import (
    BITS,
    add_rows,
    count_unlabeled,
    fewest_free,
    find_list_bits,
    find_row_bits,
    label_new,
    merge_instances,
    number_new,
    remove_instances,
    sum_classes_of_instances,
    update_rows,
)
from framework.mapping.labels.label_evidence import LARGEST_SCORE, MAX_SCORE, UNSEEN, Evidence, Measurement
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.packed_evidence import PackedEvidence, unpack_evidence
from framework.mapping.voxels.integration import SeenBlocks
from framework.mapping.voxels.voxel_grid import VoxelGrid, grown, move_forward, reserved
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS

INSTANCE_SLOTS = 4  # number of instance slots of a voxel in compact storage
MAX_SLOTS = 2**16 - 1  # maximum number of instance slots of a voxel in a map file
RESERVED = 128  # initial capacity for labeled voxels per block of `max_blocks`; most blocks need fewer
ANY_INSTANCE = np.uint64(2**BITS - 1)  # instance set with every bit set
SLOTS = Evidence._fields[1:]  # fields with one row per labeled voxel


class Storage(Enum):
    """Labels stored in a voxel: the most likely labels (COMPACT) or all labels (EXACT)."""

    COMPACT = "compact"
    EXACT = "exact"


class NewVoxels(NamedTuple):
    """The voxels of A blocks that become labeled in a frame."""

    counts: Int32  # (A,) number of new voxels of each block
    rows: Int32  # (A,) evidence row of each block
    starts: Int32  # (A,) index of the first new voxel of each block among the labeled voxels


class EvidenceRows:
    """The label evidence of a voxel grid.

    The kernels modify its `evidence`.
    """

    def __init__(
        self,
        voxels: VoxelGrid,
        combine: Combine = Combine.SUM,
        storage: Storage = Storage.COMPACT,
        score_scale: int = 64,  # quantized class score for evidence of 1
    ) -> None:
        self.voxels = voxels
        self.combine = combine
        self.storage = storage
        self.score_scale = score_scale
        self.row_count = 0
        self.voxel_count = 0  # number of voxels with slots
        self.evicted = 0  # number of slots reassigned to another label
        self._instance_slots = INSTANCE_SLOTS
        self._class_slots = CLASS_SLOTS
        self._class_id_type = class_id_type(0)
        self._free()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without reserved capacity, which may be gigabytes."""
        rows = {name: getattr(self, name)[: self.row_count] for name in ("_labeled", "_row_bits")}
        used = {**rows, "_slots": self._slots[: self.voxel_count]}
        return {**vars(self), **used, "evidence": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lay_out()

    @property
    def byte_count(self) -> int:
        """Size of the evidence in use, bytes. Unused capacity takes no memory."""
        rows = self._labeled[: self.row_count].nbytes + self._row_bits[: self.row_count].nbytes
        return rows + self._slots[: self.voxel_count].nbytes

    def in_use(self) -> Evidence:
        """Return the evidence without unused capacity."""
        slots = {name: getattr(self.evidence, name)[: self.voxel_count] for name in SLOTS}
        return Evidence(self.evidence.labeled[: self.row_count], **slots)

    def fill(self, saved: Evidence) -> None:
        """Replace the evidence with a copy of `saved`.

        `saved` may have fewer slots per voxel.
        """
        self._instance_slots = max(self._instance_slots, saved.instance_ids.shape[1])
        self._free()
        self._reserve(len(saved.labeled), len(saved.instance_ids))
        self._row_bits[: self.row_count] = ANY_INSTANCE
        own = self.in_use()
        own.labeled[:] = saved.labeled
        for name in SLOTS:
            array, given = getattr(own, name), getattr(saved, name)
            array[:, : given.shape[1]] = given
            array[:, given.shape[1] :] = 0

    def like(self, voxels: VoxelGrid) -> EvidenceRows:
        """Return empty evidence of the same kind for another grid."""
        other = EvidenceRows(voxels, self.combine, self.storage, self.score_scale)
        other._instance_slots, other._class_slots = self._instance_slots, self._class_slots
        other._class_id_type = self._class_id_type
        other._free()
        return other

    def best_instances(self) -> Int32:
        """Return the most likely instance of each labeled voxel (N,), 0 = none."""
        evidence = self.in_use()
        return np.where(evidence.instance_value[:, 0] > 0, evidence.instance_ids[:, 0], np.int32(0))

    def best_ids(self) -> Int32:
        """Return the instances that are the most likely ones of a voxel, ascending."""
        ids = np.unique(self.best_instances())
        return ids[ids > 0]

    def voxels_of(self, blocks: Int32) -> Int32:
        """Return the index (N, 512) of each voxel of the blocks (N,) among the labeled voxels, -1 = not labeled."""
        rows = self.voxels.grid.label_row[blocks]
        found = np.full((len(blocks), BLOCK_VOXELS), -1, np.int32)
        found[rows >= 0] = self._labeled[rows[rows >= 0]]
        return found

    def gather(self, source: EvidenceRows, voxels: Int32) -> None:
        """Replace the evidence with copies of evidence of the same kind.

        Args:
            source: The other evidence.
            voxels: The index (B, 512) of the source of each voxel among the labeled voxels of `source`, -1 = none.
        """
        has_row = np.asarray((voxels >= 0).any(axis=1))
        labeled = voxels[has_row]
        found = labeled >= 0
        chosen = labeled[found]
        labeled[found] = np.arange(len(chosen), dtype=np.int32)
        self._reserve(len(labeled), len(chosen))
        self._labeled[: self.row_count] = labeled
        self._slots[: self.voxel_count] = source._slots[chosen]
        find_row_bits(self.in_use(), self._row_bits)
        self._set_label_rows(has_row)

    def keep(self, blocks: Int32) -> None:
        """Remove the evidence of all other blocks. The blocks (N,) are ascending and have their old numbers."""
        label_row = self.voxels.grid.label_row
        rows = np.unique(label_row[blocks][label_row[blocks] >= 0])
        row_numbers = np.full(self.row_count + 1, -1, np.int32)  # of each old row; the last one stands for -1
        row_numbers[rows] = np.arange(len(rows))
        label_row[blocks] = row_numbers[label_row[blocks]]
        for array in (self._labeled, self._row_bits):
            move_forward(array, rows)
        labeled = self._labeled[: len(rows)]
        used = np.zeros(self.voxel_count + 1, np.bool_)
        used[labeled] = True
        used[-1] = False  # stands for -1
        numbers = np.cumsum(used, dtype=np.int32) - 1
        numbers[-1] = -1
        np.take(numbers, labeled, out=labeled, mode="wrap")
        move_forward(self._slots, np.flatnonzero(used))
        self.row_count, self.voxel_count = len(rows), int(np.count_nonzero(used))
        self._lay_out()

    def _set_label_rows(self, has_row: Bool) -> None:
        """Number the rows of the blocks (B,) that have one, in the order of the blocks."""
        rows = np.where(has_row, np.cumsum(has_row) - 1, -1)
        self.voxels.grid.label_row[: len(has_row)] = rows

    def add(self, blocks: Int32, other: EvidenceRows) -> None:
        """Add evidence of the same kind.

        Args:
            blocks: The block (B,) of each block of the other grid.
            other: The other evidence.
        """
        theirs = other.voxels.grid.label_row[: other.voxels.block_count]
        new = NewVoxels(*np.empty((3, len(blocks)), np.int32))
        label_row, evicted = self.voxels.grid.label_row, np.zeros(len(blocks), np.int32)
        if self.storage is Storage.EXACT:
            self._make_room_for_instances(other._instance_slots)
        count_unlabeled(label_row, blocks, self.evidence, theirs, other.evidence, new.counts)
        self._make_room(blocks, new)
        limit = MAX_SCORE if self.storage is Storage.COMPACT else LARGEST_SCORE
        add_rows(
            label_row, blocks, self.evidence, self._row_bits, theirs, other.evidence, other._row_bits, new,
            int(self.combine), limit, evicted,
        )  # fmt: skip
        self.evicted += int(evicted.sum())

    @property
    def max_instance_slots(self) -> int:
        """Maximum number of instance slots of a voxel."""
        return INSTANCE_SLOTS if self.storage is Storage.COMPACT else MAX_SLOTS

    def unpacked_bytes(self, saved: PackedEvidence) -> int:
        """Return the size of the evidence of a map file in memory."""
        slots = max(self._instance_slots, int(saved.instance_slots.max(initial=0)))
        row = self._labeled.itemsize * BLOCK_VOXELS + self._row_bits.itemsize
        return row * len(saved.labeled) + self._slot_type(slots).itemsize * len(saved.states)

    def unpack(self, saved: PackedEvidence) -> None:
        """Replace the evidence with the evidence of a map file."""
        self._instance_slots = max(self._instance_slots, int(saved.instance_slots.max(initial=0)))
        self._free()
        self._reserve(len(saved.labeled), len(saved.states))
        unpack_evidence(saved, self._free_classes(), self.in_use(), self._row_bits[: self.row_count])

    def begin(self, classes: int) -> None:
        """Set the number of classes before the first update."""
        self._class_id_type = class_id_type(classes)
        if self.storage is Storage.EXACT:
            self._class_slots = max(classes, 1)
        self._free()

    def update(self, seen: SeenBlocks, measurement: Measurement) -> None:
        """Update the label evidence of the voxels near the measured surface.

        Args:
            seen: The blocks updated by the frame, and their voxels near the surface.
            measurement: The evidence of the clusters of the frame.
        """
        if not (measurement.instance_id.any() or len(measurement.clusters)):
            return  # no evidence for or against any instance or class
        new = NewVoxels(*np.empty((3, len(seen.blocks)), np.int32))
        evicted = np.empty(len(seen.blocks), np.int32)
        if self.storage is Storage.EXACT:
            self._make_room_for_instances(len(measurement.instance_id))
        grid, free_classes = self.voxels.grid, self._free_classes()
        list_bits = np.empty(len(measurement.offsets) - 1, np.uint64)
        find_list_bits(measurement.offsets, measurement.clusters, measurement.instance_id, list_bits)
        update_rows(grid, seen, self.evidence, measurement, list_bits, self._row_bits, new.counts, evicted)
        self._make_room(seen.blocks, new)
        label_new(grid, seen, self.evidence, measurement, list_bits, self._row_bits, new, free_classes, evicted)
        self.evicted += int(evicted.sum())

    def add_class(self, classes: int, logarithmic: bool) -> None:
        """Add a class without evidence in any voxel. Compact storage has no slots for such classes.

        Args:
            classes: The number of classes, including the new class.
            logarithmic: True if the evidence consists of log-likelihoods.
        """
        old, id_type = self.in_use(), class_id_type(classes)
        if self.storage is Storage.COMPACT and id_type is self._class_id_type:
            return
        self._class_id_type = id_type
        if self.storage is Storage.EXACT:
            new_id = np.full((len(old.class_ids), 1), classes, id_type)
            unseen = old.class_value.max(axis=1, keepdims=True) - int(UNSEEN * self.score_scale) if logarithmic else 0
            new_value = np.broadcast_to(unseen, new_id.shape).astype(old.class_value.dtype)
            self._class_slots += 1
            old = old._replace(
                class_ids=np.concatenate([old.class_ids, new_id], axis=1),
                class_value=np.concatenate([old.class_value, new_value], axis=1),
            )
        self.fill(old)

    def merge_instances(self, kept: int, dropped: int) -> None:
        """Add the evidence for instance `dropped` to the evidence for `kept` in every voxel."""
        row_bits = self._row_bits[: self.row_count]
        merge_instances(self.evidence, row_bits, np.int32(kept), np.int32(dropped), int(self.combine))

    def remove_instances(self, instance_ids: Sequence[int]) -> None:
        """Remove the evidence for instances in every voxel.

        The class evidence of the voxels does not change, because it is not stored by instance.
        """
        remove_instances(self.evidence, self._row_bits[: self.row_count], np.array(sorted(instance_ids), np.int32))

    def renumber_instances(self, offset: int) -> None:
        """Add an offset to the ids of all instances in every voxel."""
        evidence = self.in_use()
        evidence.instance_ids[evidence.instance_ids > 0] += offset
        find_row_bits(evidence, self._row_bits)

    def blocks_with(self, instance_ids: Collection[int]) -> Int32:
        """Return the blocks that may have evidence for any of the instances, which are more than those that do."""
        if not instance_ids or not self.row_count:
            return np.zeros(0, np.int32)
        bits = np.bitwise_or.reduce(np.uint64(1) << np.array([*instance_ids], np.uint64) % np.uint64(BITS))
        label_row = self.voxels.grid.label_row[: self.voxels.block_count]
        found = (self._row_bits[: self.row_count] & bits) != 0
        return np.flatnonzero((label_row >= 0) & found[label_row]).astype(np.int32)

    def classes_of_instances(self, counts: Bool, classes: int) -> Float64:
        """Return the class evidence (ids + 1, classes) of the instances, summed over their voxels.

        A voxel belongs to its most likely instance with `counts[id]` True. All other instances have an evidence of 0.
        """
        sums = np.zeros((len(counts), classes), np.int64)
        sum_classes_of_instances(self.in_use(), counts, sums)
        return np.asarray(sums / self.score_scale)

    def _free(self) -> None:
        self._labeled = reserved(self.voxels.max_blocks, lambda rows: np.empty((rows, BLOCK_VOXELS), np.int32))
        self._row_bits = np.empty(len(self._labeled), np.uint64)  # bit k % BITS = a voxel may have instance k
        slots = self._slot_type(self._instance_slots)
        self._slots = reserved(RESERVED * self.voxels.max_blocks, lambda voxels: np.empty(voxels, slots))
        self._lay_out()

    def _slot_type(self, instance_slots: int) -> np.dtype[Any]:
        """Return the type of the slots of a voxel."""
        scores = np.int16 if self.storage is Storage.COMPACT else np.int64
        shapes = instance_slots, instance_slots, self._class_slots, self._class_slots
        kinds = zip(SLOTS, (np.int32, np.float32, self._class_id_type, scores), shapes, strict=True)
        return np.dtype([(name, kind, (count,)) for name, kind, count in kinds], align=True)

    def _lay_out(self) -> None:
        self.evidence = Evidence(self._labeled, **{name: self._slots[name] for name in SLOTS})

    def _free_classes(self) -> ClassIds:
        """Return the class ids (T,) in the slots of a new voxel."""
        # exact storage has a slot for every class
        exact = self.storage is Storage.EXACT
        named = np.arange(1, self._class_slots + 1) if exact else np.full(self._class_slots, NO_CLASS)
        return named.astype(self._class_id_type)

    def _make_room(self, blocks: Int32, new: NewVoxels) -> None:
        """Reserve slots for new voxels and rows for new blocks, and fill new.rows and new.starts."""
        before = self.row_count
        label_row = self.voxels.grid.label_row
        self._reserve(*number_new(blocks, new.counts, label_row, before, self.voxel_count, new.rows, new.starts))
        self.evidence.labeled[before : self.row_count] = -1
        self._row_bits[before : self.row_count] = 0

    def _reserve(self, rows: int, voxels: int) -> None:
        """Set the number of rows and voxels in use.

        New entries are uninitialized.
        """
        if rows > len(self._labeled):
            self._labeled = grown(self._labeled, max(rows, 2 * len(self._labeled)))
            self._row_bits = grown(self._row_bits, len(self._labeled))
        if voxels > len(self._slots):
            self._slots = grown(self._slots, max(voxels, 2 * len(self._slots)))
        self.row_count, self.voxel_count = rows, voxels
        self._lay_out()

    def _make_room_for_instances(self, new: int) -> None:
        """Double the number of instance slots until every voxel has at least `new` free slots."""
        slots = self._instance_slots
        missing = new - int(fewest_free(self.in_use().instance_ids))
        while missing > 0:
            missing -= slots
            slots *= 2
        if slots > self._instance_slots:
            self._instance_slots = slots
            self.fill(self.in_use())
