"""Cameras in JSON; every fault of a value is in the tests of the readers that use it."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.data import Camera
from framework.datasets.camera_json import camera_of, read_json_object
from framework.errors import DataError

KEYS = ("w", "h", "fx", "fy", "cx", "cy", "s")


def test_keys_are_in_the_order_of_the_camera() -> None:
    content = {"s": 1000, "cy": 7, "cx": 8, "fy": 9, "fx": 10, "h": 16, "w": 24.0, "model": "Kinect"}
    assert camera_of(Path("c.json"), content, KEYS) == (Camera(24, 16, 10, 9, 8, 7), 1000)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"c\.json could not be read: No such file"):
        read_json_object(tmp_path / "c.json")
    (tmp_path / "c.json").write_bytes(b"\xff")
    with pytest.raises(DataError, match="is not valid JSON"):
        read_json_object(tmp_path / "c.json")
