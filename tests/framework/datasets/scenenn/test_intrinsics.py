"""Tests for intrinsics files with different spellings of keys and values."""

from __future__ import annotations

import pytest

from framework.data import Camera
from framework.datasets.scenenn.scene_files import read_intrinsics, write_intrinsics
from framework.errors import DataError

ASUS = (544.47329, 544.47329, 320.0, 240.0)


def test_intrinsics_round_trip_is_exact(tmp_path):
    camera = Camera(640, 480, 544.47329, 1600 / 3, 319.5, -0.1)
    write_intrinsics(tmp_path / "asus.ini", camera)
    assert read_intrinsics(tmp_path / "asus.ini") == (camera.fx, camera.fy, camera.cx, camera.cy)
    assert (tmp_path / "asus.ini").read_text().splitlines()[:3] == [
        "depth_width 640",
        "depth_height 480",
        "fx 544.47329",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "fx 544.47329\nfy 544.47329\ncx 320\ncy 240\n",
        "fx = 544.47329\nfy=544.47329\ncx: 320\ncy:240",
        "\r\n[camera]\r\n  fx\t5.4447329e2 # px\r\nfy 544.47329;\r\ncy 240\r\ncx 320\r\nmodel fx 3\r\nk1 a : = =",
        "depth_width 640\ndepth_height 480\nfx 544.47329\nfy 544.47329\n",
        "FX 544.47329\nFy = 544.47329\nDEPTH_WIDTH 640\ncX 320\nCY:240\n",
        "depth_width 9\ncx 320\nfx 544.47329\nfy 544.47329\ncy 240\n",
    ],
)
def test_intrinsics_syntax_variants_are_read(tmp_path, text):
    (tmp_path / "asus.ini").write_bytes(text.encode())
    assert read_intrinsics(tmp_path / "asus.ini") == ASUS


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fx 544", "fx", r"asus.ini, line 2: fx: expected a value > 0 px, got ''"),
        ("fx 544", "fx 0", r"asus.ini, line 2: fx: expected a value > 0 px, got '0'"),
        ("fy 544", "fy -544", "line 3: fy: expected a value > 0 px"),
        ("cx 320", "cx nan", "line 4: cx: expected a finite value in px, got 'nan'"),
        ("cx 320", "cx 320 240", "line 4: cx: expected a finite value in px, got '320 240'"),
        ("cx 320", "depth_width 0", "line 4: depth_width: expected a value > 0 px"),
        ("cx 320", "fx 544", "line 4: fx: expected one value, got 544 and 544"),
        ("cy 240\n", "", "asus.ini: expected values of fx, fy, cx, cy, got no cy"),
    ],
)
def test_intrinsics_invalid_file_error_gives_file_and_line(tmp_path, old, new, message):
    (tmp_path / "asus.ini").write_text("# asus\nfx 544\nfy 544\ncx 320\ncy 240\n".replace(old, new))
    with pytest.raises(DataError, match=message):
        read_intrinsics(tmp_path / "asus.ini")


def test_intrinsics_missing_or_oversized_file_raises(tmp_path):
    with pytest.raises(DataError, match=r"asus.ini: expected a readable file, got an error \(No such file"):
        read_intrinsics(tmp_path / "asus.ini")
    (tmp_path / "large.ini").write_bytes(b"fx 1\n" * 2**18)
    with pytest.raises(DataError, match=r"large.ini: expected at most 1048576 bytes, got 1310720"):
        read_intrinsics(tmp_path / "large.ini")
