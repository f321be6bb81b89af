"""Tests for depth_distortion.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.pose_graph.depth_distortion_file import read_depth_distortion, write_depth_distortion
from framework.sensors.depth_distortion import NODES, DepthDistortion


def test_depth_distortion_file_is_read_as_written(tmp_path: Path) -> None:
    written = DepthDistortion(np.random.default_rng(0).normal(0, 0.01, NODES), (480, 640))
    write_depth_distortion(tmp_path / "d.json", written)
    read = read_depth_distortion(tmp_path / "d.json")
    assert read is not None
    np.testing.assert_array_equal(read.nodes, written.nodes)
    assert read.shape == (480, 640)


def test_depth_distortion_file_is_optional(tmp_path: Path) -> None:
    assert read_depth_distortion(tmp_path / "d.json") is None


@pytest.mark.parametrize(
    "changes",
    [
        {"width": None}, {"height": 0}, {"width": 1e999}, {"corrections_per_m": [[0.1] * 9] * 6},
        {"corrections_per_m": [[2.0] * 9] * 7}, {"corrections_per_m": [["x"] * 9] * 7}, {"corrections_per_m": [1, [2]]},
    ],
)  # fmt: skip
def test_depth_distortion_file_invalid_raises_error_with_name(tmp_path: Path, changes: dict[str, object]) -> None:
    content = {"width": 640, "height": 480, "corrections_per_m": [[0.0] * 9] * 7}
    (tmp_path / "d.json").write_text(json.dumps(content | changes))
    with pytest.raises(DataError, match=r"d\.json"):
        read_depth_distortion(tmp_path / "d.json")
