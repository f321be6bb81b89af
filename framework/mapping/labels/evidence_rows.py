"""Where the label evidence of the voxels is, how a frame updates all that it sees, and how it grows.

Bytes: a voxel has slots once a cluster has named an instance there, 8 bytes an instance slot and 3 a class slot, so 80
in compact storage. They are found through rows of 512 numbers, 4 bytes each, of the blocks that have such voxels. In
redkitchen (maskrcnn2go, 1 cm, 80 frames) these are 21 % of the voxels of half of the blocks, 89 bytes each with their
share of the rows: the slots lie near the surface and under masks.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np

from framework.data import Int32, UInt8
from framework.errors import DataError
from framework.mapping.labels.class_slots import CLASS_SLOTS, NO_CLASS
from framework.mapping.labels.evidence_rows_kernels import (
    BITS,
    fewest_free,
    find_named,
    label_new,
    merge_instances,
    number_new,
    update_rows,
)
from framework.mapping.labels.label_evidence import Evidence, Measurement
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.voxels.integration import SeenBlocks
from framework.mapping.voxels.voxel_grid import VoxelGrid, grown, reserved
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS
from framework.runtime.memory import PagesAhead

INSTANCE_SLOTS = 4  # instances that a voxel can tell apart in compact storage
RESERVED = 128  # voxels with slots for each block of the budget: most have fewer, and slots for more are made
ANY_INSTANCE = np.uint64(2**BITS - 1)
SLOTS = Evidence._fields[1:]


class Storage(Enum):
    """How many labels a voxel remembers."""

    COMPACT = "compact"
    EXACT = "exact"


class EvidenceRows:
    """Owns the label evidence of a grid's blocks and makes it grow. The kernels work on `self.evidence`."""

    def __init__(self, voxels: VoxelGrid, combine: Combine = Combine.SUM, storage: Storage = Storage.COMPACT) -> None:
        self.voxels = voxels
        self.combine = combine
        self.storage = storage
        self.row_count = 0
        self.voxel_count = 0  # with slots
        self.evicted = 0  # slots given to another label so far
        self._instance_slots = INSTANCE_SLOTS
        self._class_slots = CLASS_SLOTS
        self._pages = PagesAhead()
        self._free()

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: without what is only reserved, which is gigabytes."""
        rows = {name: getattr(self, name)[: self.row_count] for name in ("_labeled", "_known")}
        used = {**rows, "_slots": self._slots[: self.voxel_count]}
        return {**vars(self), **used, "evidence": None, "_pages": PagesAhead()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lay_out()

    @property
    def byte_count(self) -> int:
        """Of what is in use: capacity that no voxel has been given yet takes no memory."""
        rows = self._labeled[: self.row_count].nbytes + self._known[: self.row_count].nbytes
        return rows + self._slots[: self.voxel_count].nbytes

    def in_use(self) -> Evidence:
        """The evidence without capacity that is free."""
        slots = {name: getattr(self.evidence, name)[: self.voxel_count] for name in SLOTS}
        return Evidence(self.evidence.labeled[: self.row_count], **slots)

    def fill(self, saved: Evidence) -> None:
        """Takes over the evidence of a saved map, or its own with fewer slots for instances."""
        self._instance_slots = max(self._instance_slots, saved.instance_ids.shape[1])
        self._free()
        self._reserve(len(saved.labeled), len(saved.instance_ids))
        self._known[: self.row_count] = ANY_INSTANCE
        own = self.in_use()
        own.labeled[:] = saved.labeled
        for name in SLOTS:
            array, given = getattr(own, name), getattr(saved, name)
            array[:, : given.shape[1]] = given
            array[:, given.shape[1] :] = 0

    def begin(self, classes: int) -> None:
        """Says how many classes there are, before the first update. Raises DataError when they are too many."""
        if classes > NO_CLASS:
            raise DataError(f"a map tells {NO_CLASS} classes apart, and the detector has {classes}")
        if self.storage is Storage.EXACT:
            self._class_slots = max(classes, 1)
            self._free()

    def update(self, seen: SeenBlocks, measurement: Measurement) -> None:
        """Updates the voxels near the measured surface of the blocks that a frame has seen."""
        if not measurement.instance_id.any():
            return  # the frame says nothing, neither for an instance nor against one
        of_pixel = measurement.of_pixel.ravel()
        new = np.empty(len(seen.blocks), np.int32)
        evicted = np.empty(len(seen.blocks), np.int32)
        if self.storage is Storage.EXACT:
            self._make_room_for_instances(len(measurement.instance_id))
        grid, free_classes = self.voxels.grid, self._free_classes()
        named = np.empty(len(measurement.first) - 1, np.uint64)
        find_named(measurement.first, measurement.cluster, measurement.instance_id, named)
        update_rows(grid, seen, self.evidence, measurement, of_pixel, named, self._known, new, evicted)
        rows, first_new = self._make_room(seen.blocks, new)
        label_new(
            grid, seen, self.evidence, measurement, of_pixel, named, self._known, new, rows, first_new, free_classes,
            evicted,
        )  # fmt: skip
        self.evicted += int(evicted.sum())

    def merge_instances(self, kept: int, dropped: int) -> None:
        """Combines the evidence for instance `dropped` with that for `kept` in every voxel.

        Rare, and it goes through the blocks in which the dropped one was named, and one in 64 others.
        """
        known = self._known[: self.row_count]
        merge_instances(self.evidence, known, np.int32(kept), np.int32(dropped), int(self.combine))

    def _free(self) -> None:
        self._labeled = reserved(self.voxels.max_blocks, lambda rows: np.empty((rows, BLOCK_VOXELS), np.int32))
        self._known = np.empty(len(self._labeled), np.uint64)  # a row's instances: those that its voxels may know
        units = np.int16 if self.storage is Storage.COMPACT else np.int64
        shapes = self._instance_slots, self._instance_slots, self._class_slots, self._class_slots
        kinds = zip(SLOTS, (np.int32, np.float32, np.uint8, units), shapes, strict=True)
        slots = np.dtype([(name, kind, (count,)) for name, kind, count in kinds], align=True)
        self._slots = reserved(RESERVED * self.voxels.max_blocks, lambda voxels: np.empty(voxels, slots))
        self._lay_out()

    def _lay_out(self) -> None:
        self.evidence = Evidence(self._labeled, **{name: self._slots[name] for name in SLOTS})

    def _free_classes(self) -> UInt8:
        """What a new voxel's class slots hold: nothing, or in exact storage every class."""
        named = np.arange(self._class_slots) if self.storage is Storage.EXACT else np.full(self._class_slots, NO_CLASS)
        return named.astype(np.uint8)

    def _make_room(self, blocks: Int32, new: Int32) -> tuple[Int32, Int32]:
        """Reserves slots for so many `new` (A,) voxels of each of these blocks, and rows for the blocks without one.

        Returns the row of each block (A,) and the number of its first new voxel (A,).
        """
        rows_before = self.row_count
        rows, first_new = np.empty((2, len(blocks)), np.int32)
        self._reserve(
            *number_new(blocks, new, self.voxels.grid.label_row, rows_before, self.voxel_count, rows, first_new)
        )
        self.evidence.labeled[rows_before : self.row_count] = -1
        self._known[rows_before : self.row_count] = 0
        return rows, first_new

    def _reserve(self, rows: int, voxels: int) -> None:
        """Has so many rows and voxels in use; the new ones hold anything."""
        if rows > len(self._labeled):
            self._labeled = grown(self._labeled, max(rows, 2 * len(self._labeled)))
            self._known = grown(self._known, len(self._labeled))
        if voxels > len(self._slots):
            self._slots = grown(self._slots, max(voxels, 2 * len(self._slots)))
        self.row_count, self.voxel_count = rows, voxels
        self._lay_out()
        self._pages.ask([self._labeled], rows)
        self._pages.ask([self._slots], voxels)

    def _make_room_for_instances(self, new: int) -> None:
        """Doubles the slots until every voxel has `new` free ones."""
        slots = self._instance_slots
        missing = new - int(fewest_free(self.in_use().instance_ids))
        while missing > 0:
            missing -= slots
            slots *= 2
        if slots > self._instance_slots:
            self._instance_slots = slots
            self.fill(self.in_use())
