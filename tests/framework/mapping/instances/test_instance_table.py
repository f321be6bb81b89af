"""Tests for the table of instances."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from framework.mapping.instances.instance_list import Confirmation
from framework.mapping.instances.instance_table import PAGE, FrameSet, InstanceTable

frames = st.lists(st.integers(-2 * PAGE, 3 * PAGE))


@given(frames, frames)
def test_frame_set_matches_python_set(ours: list[int], theirs: list[int]) -> None:
    """The frames are added in arbitrary order, and read from the pages."""
    a, b = FrameSet(), FrameSet()
    for found, expected in ((a, ours), (b, theirs)):
        for k in expected:
            found.add(k)
    for found, plain in ((a, set(ours)), (b, set(theirs)), (a | b, {*ours, *theirs}), (FrameSet(a.pages), set(ours))):
        assert len(found) == len(plain)
        bits = {PAGE * page + k for page, bits in found.pages.items() for k in range(PAGE) if bits >> k & 1}
        assert bits == plain
        assert found.last() == max(plain, default=-1)


def test_frame_set_takes_two_bits_per_frame() -> None:
    frames = 20 * PAGE
    tracemalloc.start()
    found = FrameSet()
    for k in range(frames):
        found.add(k)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found) == frames
    assert 8 * size < 2 * frames


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
    """The reference tests all instances after each frame, and searches all of them for tentative ones."""
    rng = np.random.default_rng(seed)
    table, condition = InstanceTable(), Confirmation(3, 0.2)
    ever: set[int] = set()  # instances that have been confirmed
    detected: dict[int, int] = {}  # last frame with a detection of each instance
    removed, reused = set(), set()
    for frame in range(300):
        table.detected_frames += 1
        for _ in range(rng.integers(0, 2)):
            expected = min(removed, default=len(detected) + 1)
            new = table.create(1, frame).id
            assert new == expected
            reused |= removed & {new}
            removed.discard(new)
            table.observe(new, np.zeros(1), 0.5, frame)
            detected[new] = frame
        known = [*table.records]
        seen = rng.choice(known, rng.integers(0, min(len(known), 4) + 1), replace=False).tolist()
        for k in seen[: rng.integers(0, 3)]:
            table.observe(k, np.zeros(1), float(rng.random()), frame)
            detected[k] = frame
        table.see(seen, frame)
        if len(known) > 3 and rng.random() < 0.1:
            kept, dropped = rng.choice(known, 2, replace=False).tolist()
            table.merge(kept, dropped)
            if dropped not in ever:
                removed.add(dropped)
                detected[kept] = frame
            else:
                ever.add(kept)
        confirmed = {k for k, record in table.records.items() if condition.is_met(record)}
        ever |= confirmed
        assert table.confirmed(condition) == confirmed
        expired = {k for k in table.records if k not in ever and frame - detected[k] >= 20}
        assert set(table.unseen(20)) == expired
        for k in expired:
            table.release(k)
        removed |= expired
        assert {*table.tentative} == table.records.keys() - ever
    assert ever
    assert reused
    assert table.confirmed(Confirmation(1, 0.0)) == table.records.keys()


def test_instance_table_without_change_returns_same_ids() -> None:
    table, condition = InstanceTable(), Confirmation(1, 0.5)
    for k in range(3):
        table.observe(table.create(1, 0).id, np.zeros(1), 0.9, k)
    confirmed = table.confirmed(condition)
    table.see([1, 2], 7)
    assert confirmed == {1, 2, 3}
    table.observe(1, np.zeros(1), 0.9, 7)
    assert table.confirmed(condition) - {2} == {1, 3}
    before = table.confirmed(condition)
    table.observe(1, np.zeros(1), 0.9, 8)
    assert table.confirmed(condition) is before
