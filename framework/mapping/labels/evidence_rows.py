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
from numba import njit, prange

from framework.data import Int32, UInt8
from framework.errors import DataError
from framework.mapping.labels.class_slots import CLASS_SLOTS, NO_CLASS
from framework.mapping.labels.label_evidence import (
    UNBOUNDED,
    Combine,
    Evidence,
    Measurement,
    add_evidence,
    best_first,
    update_voxel,
)
from framework.mapping.prefetching import prefetch_line, prefetch_row
from framework.mapping.voxels.bit_slices import ONE
from framework.mapping.voxels.integration import GROUP, SeenBlocks
from framework.mapping.voxels.voxel_grid import BLOCK_VOXELS, VoxelGrid, device, grown, one_more, reserved
from framework.runtime.memory import PagesAhead

INSTANCE_SLOTS = 4  # instances that a voxel can tell apart in compact storage
RESERVED = 128  # voxels with slots for each block of the budget: most have fewer, and slots for more are made
BITS = 64  # of a word that tells which instances a row may know: instance k is bit k % BITS
ANY_INSTANCE = np.uint64(2**BITS - 1)
SLOTS = Evidence._fields[1:]


class Storage(Enum):
    """How many labels a voxel remembers."""

    COMPACT = "compact"
    EXACT = "exact"


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
def _find_named(first, cluster, instance_id, named):
    """Fills named (L,) with the bits of the instances of each list's clusters."""
    for i in range(named.shape[0]):
        named[i] = 0
        for place in range(first[i], first[i + 1]):
            named[i] |= _instance_bit(instance_id[cluster[place]])


@njit(cache=True, nogil=True, parallel=True)
def _update(grid, seen, evidence, measurement, of_pixel, named, known, new, evicted):
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
def _number_new(blocks, new, row_of, row_count, voxel_count, rows, first_new):
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
def _label_new(grid, seen, evidence, measurement, of_pixel, named, known, new, rows, first_new, free_classes, evicted):
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
def _fewest_free(instance_ids):
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
def _merge(evidence, known, kept, dropped, combine):
    """Merges in the rows that may know the dropped instance, of known (R,), which then may know the other one."""
    for row in prange(known.shape[0]):
        if known[row] & _instance_bit(dropped):
            known[row] |= _instance_bit(kept)
            for voxel in evidence.labeled[row]:
                if voxel >= 0:
                    _merge_voxel(evidence.instance_ids[voxel], evidence.instance_value[voxel], kept, dropped, combine)


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
        _find_named(measurement.first, measurement.cluster, measurement.instance_id, named)
        _update(grid, seen, self.evidence, measurement, of_pixel, named, self._known, new, evicted)
        rows, first_new = self._make_room(seen.blocks, new)
        _label_new(
            grid, seen, self.evidence, measurement, of_pixel, named, self._known, new, rows, first_new, free_classes,
            evicted,
        )  # fmt: skip
        self.evicted += int(evicted.sum())

    def merge_instances(self, kept: int, dropped: int) -> None:
        """Combines the evidence for instance `dropped` with that for `kept` in every voxel.

        Rare, and it goes through the blocks in which the dropped one was named, and one in 64 others.
        """
        known = self._known[: self.row_count]
        _merge(self.evidence, known, np.int32(kept), np.int32(dropped), int(self.combine))

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
            *_number_new(blocks, new, self.voxels.grid.label_row, rows_before, self.voxel_count, rows, first_new)
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
        missing = new - int(_fewest_free(self.in_use().instance_ids))
        while missing > 0:
            missing -= slots
            slots *= 2
        if slots > self._instance_slots:
            self._instance_slots = slots
            self.fill(self.in_use())
