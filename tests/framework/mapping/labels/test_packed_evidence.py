"""Tests for the label evidence of map files, compared with a voxel-by-voxel reference."""

from __future__ import annotations

import numpy as np
import pytest

from framework.errors import DataError
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.evidence_rows import SLOTS, EvidenceRows, Storage
from framework.mapping.labels.evidence_rows_kernels import BITS
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.labels.packed_evidence import PackedEvidence, checked_evidence, pack_evidence
from framework.mapping.voxels.voxel_grid import VoxelGrid

pytestmark = pytest.mark.integration

CLASSES = 20
STORAGES = pytest.mark.parametrize("storage", Storage)


def empty(storage: Storage) -> EvidenceRows:
    rows = EvidenceRows(VoxelGrid(0.01, 0.05, 100), storage=storage)
    rows.begin(CLASSES)
    return rows


def evidence_of(storage: Storage) -> Evidence:
    """Return rows with no, few and 512 labeled voxels, numbered at random. Many of them have equal evidence."""
    rng = np.random.default_rng(0)
    rows = empty(storage)
    like = rows.evidence
    is_labeled = rng.random((70, 512)) < np.linspace(0, 1, 70)[:, None]
    count = int(is_labeled.sum())
    labeled = np.full(is_labeled.shape, -1, np.int32)
    labeled[is_labeled] = rng.permutation(count)
    used = rng.integers(0, 3, (count, 1)) > np.arange(like.instance_ids.shape[1])
    ids = np.where(used, 1 + (np.arange(used.shape[1]) + rng.integers(0, 3, (count, 1))) % 3, 0)
    values = np.where(used, rng.choice([-1.5, -0.0, 0.0, 2.5], used.shape), 0)
    slots = like.class_ids.shape[1]
    filled = np.arange(slots) < (rng.integers(1, 4, (count, 1)) if storage is Storage.COMPACT else slots)
    classes = np.where(filled, 1 + (np.arange(slots) + rng.integers(0, 2, (count, 1))) % CLASSES, NO_CLASS)
    scores = np.where(filled, rng.integers(-2, 3, (count, 1)), 0)
    arrays = zip(SLOTS, (ids, values, classes, scores), strict=True)
    return Evidence(labeled, **{name: array.astype(getattr(like, name).dtype) for name, array in arrays})


@STORAGES
def test_packed_evidence_round_trip_is_exact(storage: Storage) -> None:
    expected, rows = evidence_of(storage), empty(storage)
    packed = pack_evidence(expected)
    rows.unpack(checked_evidence(packed._asdict(), rows.evidence, rows.max_instance_slots))
    found, is_labeled = rows.in_use(), expected.labeled >= 0
    np.testing.assert_array_equal(found.labeled[is_labeled], np.arange(is_labeled.sum()))
    assert (found.labeled[~is_labeled] == -1).all()
    for name in SLOTS:
        array = getattr(found, name)
        assert array.tobytes() == getattr(expected, name)[expected.labeled[is_labeled]].tobytes(), name
    for again, first in zip(pack_evidence(found), packed, strict=True):
        np.testing.assert_array_equal(again, first)


def test_packed_evidence_contains_each_state_of_a_block_once() -> None:
    expected = evidence_of(Storage.COMPACT)
    packed, k = pack_evidence(expected), 0
    for row, voxels in enumerate(expected.labeled):
        states = [tuple(getattr(expected, name)[voxel].tobytes() for name in SLOTS) for voxel in voxels[voxels >= 0]]
        distinct = list(dict.fromkeys(states))
        assert packed.state_counts[row] == len(distinct)
        assert packed.states[k : k + len(states)].tolist() == [distinct.index(state) for state in states]
        k += len(states)


def test_packed_evidence_restores_instance_sets() -> None:
    """A merge visits the rows whose set contains the dropped instance."""
    expected, rows = evidence_of(Storage.COMPACT), empty(Storage.COMPACT)
    rows.unpack(pack_evidence(expected))
    for row, voxels in enumerate(expected.labeled):
        for key in np.unique(expected.instance_ids[voxels[voxels >= 0]]):
            assert int(rows._row_bits[row]) >> (int(key) % BITS) & 1
    rows.merge_instances(1, 2)
    assert not (rows.in_use().instance_ids == 2).any()


def test_packed_evidence_omits_values_of_free_slots() -> None:
    rows, evidence = empty(Storage.COMPACT), evidence_of(Storage.COMPACT)
    expected = pack_evidence(evidence)
    for labels, values, free in (
        (evidence.instance_ids, evidence.instance_value, 0),
        (evidence.class_ids, evidence.class_value, NO_CLASS),
    ):
        values[labels == free] = 7
    packed = pack_evidence(evidence)
    for name in PackedEvidence._fields:
        np.testing.assert_array_equal(getattr(packed, name), getattr(expected, name), err_msg=name)
    checked_evidence(packed._asdict(), rows.evidence, rows.max_instance_slots)


@STORAGES
@pytest.mark.parametrize("name", PackedEvidence._fields)
def test_packed_evidence_of_wrong_length_raises(storage: Storage, name: str) -> None:
    arrays, rows = pack_evidence(evidence_of(storage))._asdict(), empty(storage)
    with pytest.raises(DataError, match="expected shape"):
        checked_evidence(arrays | {name: arrays[name][:-1]}, rows.evidence, rows.max_instance_slots)


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("states", 511, r"states: expected less than \d+ in row \d+, got 511"),
        ("state_counts", 513, r"state_counts: expected numbers in \[0, 512\]"),
        ("instance_slots", 5, r"instance_slots: expected numbers in \[0, 4\], got 0 to 5"),
        ("class_slots", 17, r"class_slots: expected numbers in \[1, 16\]"),
        ("class_slots", 0, r"class_slots: expected numbers in \[1, 16\], got 0"),
    ],
)
def test_packed_evidence_with_wrong_index_raises(name: str, wrong: int, message: str) -> None:
    arrays, rows = pack_evidence(evidence_of(Storage.COMPACT))._asdict(), empty(Storage.COMPACT)
    arrays[name] = arrays[name].copy()
    arrays[name][0] = wrong
    with pytest.raises(DataError, match=message):
        checked_evidence(arrays, rows.evidence, rows.max_instance_slots)
