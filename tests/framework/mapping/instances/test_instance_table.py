"""Tests for the table of instances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from framework.mapping.instances.instance_table import FrameSet, InstanceTable

frames = st.lists(st.integers(0, 40))


@given(frames, frames)
def test_frame_set_matches_python_set(ours: list[int], theirs: list[int]) -> None:
    """The frames are added in arbitrary order."""
    a, b = FrameSet(), FrameSet()
    for found, expected in ((a, ours), (b, theirs)):
        for k in expected:
            found.add(k)
    for found, expected in ((a, set(ours)), (b, set(theirs)), (a | b, {*ours, *theirs})):
        assert len(found) == len(expected)
        assert {k for first, last in found.spans for k in range(first, last + 1)} == expected
        assert all(before[1] + 1 < after[0] for before, after in zip(found.spans, found.spans[1:], strict=False))


@pytest.mark.parametrize("second", [range(10, 20), range(5, 15)], ids=["consecutive", "half overlapping"])
def test_instance_table_merge_equals_unfragmented_instance(second: range) -> None:
    """Each instance is detected in every other frame in which it is visible."""
    table = InstanceTable()
    seen = {table.create(1, 0).id: range(10), table.create(1, 0).id: second, table.create(1, 0).id: range(second.stop)}
    for instance_id, in_view in seen.items():
        for k in in_view:
            table.records[instance_id].in_view.add(k)
            if k % 2 == 0:
                table.observe(instance_id, np.zeros(1), 0.8, k)
    table.merge(1, 2)
    merged, whole = table.records[1], table.records[3]
    assert whole.visible == second.stop
    assert (merged.observations, merged.visible) == (whole.observations, whole.visible)
    assert merged.confidence == pytest.approx(whole.confidence)
