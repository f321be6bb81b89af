"""Tests for the table of instances."""

import copy
import pickle
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from framework.mapping.instances.instance_list import Confirmation
from framework.mapping.instances.instance_table import PAGE, FrameSet, InstanceTable
from framework.runtime.spooled_list import Spool

frames = st.lists(st.integers(-2 * PAGE, 3 * PAGE))


def frames_of(found: FrameSet) -> set[int]:
    return {PAGE * number + k for number, bits in found.pages().items() for k in range(PAGE) if bits >> k & 1}


@given(frames, frames)
def test_frame_set_matches_python_set(ours: list[int], theirs: list[int]) -> None:
    """The frames are added in arbitrary order, and the sets share a file."""
    spool = Spool()
    a, b = FrameSet(spool), FrameSet(spool)
    for found, expected in ((a, ours), (b, theirs)):
        for k in expected:
            found.add(k)
    pairs = (a, set(ours)), (b, set(theirs)), (a | b, {*ours, *theirs}), (FrameSet(spool, a.pages()), set(ours))
    for found, plain in pairs:
        assert len(found) == len(plain)
        assert frames_of(found) == plain
        assert found.last() == max(plain, default=-1)
    assert (a == b) is (set(ours) == set(theirs))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda found: pickle.loads(pickle.dumps(found))])
def test_frame_set_copy_is_independent(copied: Callable[[FrameSet], FrameSet]) -> None:
    found = FrameSet(Spool(), {0: 5, 1: 1, 7: 1 << 9})
    other = copied(found)
    assert other == found
    other.add(9 * PAGE)
    found.add(8 * PAGE)
    assert frames_of(found) == {0, 2, PAGE, 7 * PAGE + 9, 8 * PAGE}
    assert frames_of(other) == {0, 2, PAGE, 7 * PAGE + 9, 9 * PAGE}


def test_frame_set_needs_no_memory_per_frame() -> None:
    found = FrameSet(Spool())
    for k in range(2 * PAGE):
        found.add(k)
    tracemalloc.start()
    for k in range(2 * PAGE, 50 * PAGE):
        found.add(k)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found) == 50 * PAGE
    assert size < 3 * PAGE / 8


def test_frame_set_on_full_disk_stays_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    spool = Spool()
    found = FrameSet(spool)
    for k in (0, PAGE, 2 * PAGE):
        found.add(k)
    monkeypatch.setattr(spool, "write", lambda _: None)
    for k in (3 * PAGE, 4 * PAGE, 4 * PAGE + 1):
        found.add(k)
    monkeypatch.undo()
    found.add(5 * PAGE)
    assert frames_of(found) == {*range(0, 6 * PAGE, PAGE), 4 * PAGE + 1}


@pytest.mark.parametrize("second", [range(10, 20), range(5, 15)], ids=["consecutive", "half overlapping"])
def test_instance_table_merge_equals_unfragmented_instance(second: range) -> None:
    """Each instance is detected in every other frame in which it is visible."""
    table = InstanceTable()
    seen = {table.create(1, 0).id: range(10), table.create(1, 0).id: second, table.create(1, 0).id: range(second.stop)}
    for instance_id, in_view in seen.items():
        for k in in_view:
            table.see([instance_id], k)
            if k % 2 == 0:
                table.observe(instance_id, np.zeros(1), 0.8, k)
    table.merge(1, 2)
    merged, whole = table.records[1], table.records[3]
    assert whole.visible == second.stop
    assert (merged.observations, merged.visible) == (whole.observations, whole.visible)
    assert merged.confidence == pytest.approx(whole.confidence)


@pytest.mark.parametrize("seed", range(5))
def test_instance_table_random_operations_match_reference(seed: int) -> None:
    """The reference tests all instances after each frame, and counts the frames without a detection of each."""
    rng = np.random.default_rng(seed)
    table, condition = InstanceTable(), Confirmation(3, 0.2)
    age: dict[int, int] = {}  # age of each tentative instance
    expired_ids: set[int] = set()
    lost = 0  # number of instances that became tentative again
    for frame in range(300):
        table.frames_detected += 1
        for _ in range(rng.integers(0, 2)):
            new = table.create(1, frame).id
            assert new == 1 + max([0, *expired_ids, *table.records.keys() - {new}])
            table.observe(new, np.zeros(1), 0.5, frame)
        known = [*table.records]
        seen = rng.choice(known, rng.integers(0, min(len(known), 4) + 1), replace=False).tolist()
        detected = set(seen[: rng.integers(0, 3)])
        for k in detected:
            table.observe(k, np.zeros(1), float(rng.random()), frame)
        table.see(seen, frame)
        if len(known) > 3 and rng.random() < 0.1:
            kept, dropped = rng.choice(known, 2, replace=False).tolist()
            table.merge(kept, dropped)
            expired_ids.add(dropped)  # never used again either
            detected.add(kept)
        tentative = {k for k, record in table.records.items() if not condition.is_met(record)}
        lost += len(tentative - age.keys() - detected - {table.last_id})
        age = {k: 0 if k in detected else age.get(k, -1) + 1 for k in tentative}
        age = {k: 0 if table.records[k].first_frame == frame else n for k, n in age.items()}
        assert table.confirmed(condition) == table.records.keys() - tentative
        assert {k: table.frames_detected - n for k, n in table.tentative.items()} == age
        expired = {k for k in tentative if age[k] >= 20}
        assert set(table.undetected(condition, 20)) == expired
        for k in expired:
            table.remove(k)
            del age[k]
        expired_ids |= expired
    assert expired_ids
    assert lost
    assert table.confirmed(Confirmation(1, 0.0)) == table.records.keys()
    assert not table.tentative


def test_instance_table_flags_are_exact() -> None:
    table = InstanceTable()
    for last_id in (1, 2, 7, 8, 40):
        while table.last_id < last_id:
            table.create(1, 0)
        for ids in ([last_id, 1], [0], []):
            flags = table.flags(np.int32(ids))
            assert np.flatnonzero(flags).tolist() == sorted({*ids})
            assert len(flags) > last_id


def test_instance_table_without_change_returns_same_set() -> None:
    table, condition = InstanceTable(), Confirmation(1, 0.5)
    for k in range(3):
        table.observe(table.create(1, 0).id, np.zeros(1), 0.9, k)
    confirmed = table.confirmed(condition)
    table.see([1, 2], 7)
    assert confirmed == {1, 2, 3}
    table.observe(1, np.zeros(1), 0.9, 7)
    assert table.confirmed(condition) == {1, 2, 3}
    before = table.confirmed(condition)
    table.observe(1, np.zeros(1), 0.9, 8)
    assert table.confirmed(condition) is before
