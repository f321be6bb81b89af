"""Tests for timings.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.runs.run_directory import write_timings
from framework.runs.timings_file import read_timings
from framework.runtime.run_log import RunResult, StageTime
from tests.support.scenes.corner_room import GridMap


def test_timings_file_round_trip_has_nan_for_missing_stages(tmp_path: Path) -> None:
    times = (
        *(StageTime(4, "tracking", 2.5), StageTime(4, "fusion", 20.0)),
        StageTime(6, "tracking", 3.0),  # a lost frame is not fused
        *(StageTime(8, "tracking", 3.5), StageTime(8, "fusion", 0.0)),
    )
    result = RunResult(GridMap(10), frames=3, frames_skipped=0, tracked=(), timings=times, seconds=1.0)
    write_timings(tmp_path / "timings.csv", result)
    found = read_timings(tmp_path / "timings.csv")
    np.testing.assert_array_equal(found.frames, [4, 6, 8])
    assert list(found.milliseconds) == ["tracking", "fusion"]
    np.testing.assert_array_equal(found.milliseconds["tracking"], [2.5, 3, 3.5])
    np.testing.assert_array_equal(found.milliseconds["fusion"], [20, np.nan, 0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "line 1: expected frame,stage,milliseconds, got ''"),
        ("a,b\n", "line 1: expected frame,stage,milliseconds, got 'a,b'"),
        ("frame,stage,milliseconds\n", "expected at least one time, got none"),
        ("frame,stage,milliseconds\n0,fusion,1\n0,fusion\n", "line 3: .* got '0,fusion'"),
        ("frame,stage,milliseconds\n0,fusion,nan\n", "line 2: .* got '0,fusion,nan'"),
        ("frame,stage,milliseconds\n0,fusion,-1\n", "line 2: "),
        ("frame,stage,milliseconds\n1e3,fusion,1\n", "line 2: "),
        (f"frame,stage,milliseconds\n{10**18},fusion,1\n", "line 2: "),
        (f"frame,stage,milliseconds\n{'9' * 5000},fusion,1\n", "line 2: "),
        ('frame,stage,milliseconds\n0,"' + "x" * 200000, r"expected valid CSV, got an error \(field larger"),
        ("frame,stage,milliseconds\n0,\x00,1\n0,fusion\n", "line 3: "),
    ],
)
def test_read_timings_invalid_line_raises_with_line_number(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "timings.csv"
    path.write_text(content)
    with pytest.raises(DataError, match=message) as caught:
        read_timings(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200 + len(str(path))


def test_read_timings_unreadable_file_raises(tmp_path: Path) -> None:
    (tmp_path / "timings.csv").write_bytes(b"\xff\xfe")
    for name, output in (("timings.csv", "expected UTF-8 text"), ("none.csv", "expected a readable file")):
        with pytest.raises(DataError, match=f"{name}: {output}"):
            read_timings(tmp_path / name)
