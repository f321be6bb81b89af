"""Tests for cameras in JSON files. Invalid values are covered by the tests for the dataset readers."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.data import Camera
from framework.datasets.calibration.camera_json import camera_of, distortion_of, read_json_object
from framework.datasets.calibration.undistortion import Distortion
from framework.errors import DataError

KEYS = ("w", "h", "fx", "fy", "cx", "cy", "s")


def test_camera_json_keys_map_to_camera_fields() -> None:
    content = {"s": 1000, "cy": 7, "cx": 8, "fy": 9, "fx": 10, "h": 16, "w": 24.0, "model": "Kinect"}
    assert camera_of(Path("c.json"), content, KEYS) == (Camera(24, 16, 10, 9, 8, 7), 1000)


def test_camera_json_missing_or_invalid_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"c\.json: expected a readable file, got an error \(No such file"):
        read_json_object(tmp_path / "c.json")
    (tmp_path / "c.json").write_bytes(b"\xff")
    with pytest.raises(DataError, match="expected valid JSON"):
        read_json_object(tmp_path / "c.json")


def test_camera_json_lens_distortion_is_read() -> None:
    assert distortion_of(Path("c.json"), {}) is None
    content = {"distortion": [0.1, -0.2, 0, 0.001, 1]}
    assert distortion_of(Path("c.json"), content) == Distortion(k1=0.1, k2=-0.2, p1=0, p2=0.001, k3=1)


@pytest.mark.parametrize("value", [0.1, [0.1, 0.2, 0, 0], [0.1] * 8, {"k1": 0.1}, None])
def test_camera_json_distortion_without_five_numbers_raises(value: object) -> None:
    with pytest.raises(DataError, match=r"c\.json: distortion \[k1, k2, .*: expected a list of 5 numbers, got"):
        distortion_of(Path("c.json"), {"distortion": value})


def test_camera_json_text_distortion_coefficient_raises() -> None:
    with pytest.raises(DataError, match=r"c\.json: distortion .* 5 numbers, got .*'0\.2'"):
        distortion_of(Path("c.json"), {"distortion": [0.1, 0, "0.2", 0, 0]})
