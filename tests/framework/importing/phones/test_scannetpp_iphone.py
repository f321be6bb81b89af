"""Tests for the iPhone recordings of ScanNet++."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.api import open_dataset
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.formats import open_source
from framework.sensors.noise_models import SensorKind
from tests.support.recordings.phone_exports import seen_by_phone
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, imported
from tests.support.recordings.scannetpp_files import lz4_blocks, single_stream, write_scannetpp, zlib_blocks

FRAMES = desk_frames()
LIDAR = tuple(seen_by_phone(list(open_dataset("desk", stop=30, stride=10))))  # depth of 256x192 px


@pytest.mark.parametrize("name", ["", "iphone"])
def test_scannetpp_desk_round_trip_preserves_frames(tmp_path: Path, name: str) -> None:
    write_scannetpp(tmp_path / "scene", FRAMES)
    assert not imported(tmp_path / "scene" / name, tmp_path / "out")
    sequence = RgbdFolder(tmp_path / "out")
    assert sequence.sensor_kind is SensorKind.PHONE_LIDAR
    check_round_trip(FRAMES, sequence)
    for frame, seen in zip(FRAMES, sequence, strict=True):
        np.testing.assert_allclose(frame.T_world_camera[:3, :3] @ seen.up, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("write_depth", [single_stream, zlib_blocks, lz4_blocks])
def test_scannetpp_binary_depth_is_decompressed(tmp_path: Path, write_depth: Callable[..., None]) -> None:
    if write_depth is lz4_blocks:
        pytest.importorskip("lz4.block")
    write_scannetpp(tmp_path / "scene", LIDAR, 1, write_depth, video=True)
    source = open_source(tmp_path / "scene")
    for frame, read in zip(LIDAR, source.frames, strict=True):
        found = read()
        np.testing.assert_array_equal(found.depth, frame.depth_mm / np.float32(1000))
        np.testing.assert_allclose(found.T_world_camera, frame.T_world_camera, atol=1e-9)
        assert np.abs(found.color.astype(int) - frame.color).mean() < 8


def test_scannetpp_stride_skips_frames_of_stream(tmp_path: Path) -> None:
    write_scannetpp(tmp_path / "scene", LIDAR, 1, single_stream)
    frames = list(open_source(tmp_path / "scene").frames)
    np.testing.assert_array_equal(frames[2]().depth, LIDAR[2].depth_mm / np.float32(1000))
    with pytest.raises(DataError, match=r"depth.bin: frame 0: expected increasing frame numbers, got 0 after 2"):
        frames[0]()


def change(scene: Path, how: Callable[[dict[str, Any]], Any]) -> None:
    path = scene / "iphone/pose_intrinsic_imu.json"
    content = json.loads(path.read_text())
    how(content)
    path.write_text(json.dumps(content))


DAMAGED = [
    (lambda f: f.pop("aligned_pose"), "frame_000010: aligned_pose: expected 4 lists of 4 numbers, got None"),
    (lambda f: f.update(aligned_pose=[[0] * 4] * 4), "aligned_pose: pose: expected the last row 0 0 0 1"),
    (lambda f: f.update(intrinsic=[[1, 2]] * 3), "intrinsic: expected a list of 3 numbers"),
    (lambda f: f.update(intrinsic=[[0] * 3] * 3), "Camera: expected positive fx, fy"),
    (lambda f: f.pop("timestamp"), "expected a key 'timestamp', got none"),
]


@pytest.mark.parametrize(("how", "message"), DAMAGED)
def test_scannetpp_damaged_frame_is_skipped(tmp_path: Path, how: Callable[..., Any], message: str) -> None:
    write_scannetpp(tmp_path / "scene", FRAMES)
    change(tmp_path / "scene", lambda content: how(content["frame_000010"]))
    [error] = imported(tmp_path / "scene", tmp_path / "out")
    assert re.search(message, error), error
    assert len(RgbdFolder(tmp_path / "out")) == 2


@pytest.mark.parametrize("name", ["rgb/frame_000010.jpg", "depth/frame_000010.png"])
def test_scannetpp_missing_image_skips_one_frame(tmp_path: Path, name: str) -> None:
    write_scannetpp(tmp_path / "scene", FRAMES)
    (tmp_path / "scene/iphone" / name).unlink()
    [error] = imported(tmp_path / "scene", tmp_path / "out")
    assert re.search(f"{name}: expected a readable file", error), error


@pytest.mark.parametrize(
    ("write_depth", "cut", "message"),
    [
        (single_stream, -100, "depth.bin: frame 2: expected 196608 bytes, got the end of the stream"),
        (single_stream, 100, "depth.bin: frame 0: expected 196608 bytes, got the end of the stream"),
        (
            lambda path, depths: path.write_bytes(b"\xff" * 5000),
            5000,
            "frame 0: expected a zlib stream, got damaged data",
        ),
        (lambda path, depths: zlib_blocks(path, depths[:2]), None, "frame 2: expected a frame number of at most 1"),
        (
            lambda path, depths: path.write_bytes(3 * (b"\4\0\0\0" + b"\xff" * 4)),
            None,
            "frame 0: expected an LZ4 block of 98304 bytes or a zlib stream of 196608 bytes, got damaged data",
        ),
    ],
)
def test_scannetpp_damaged_binary_depth_names_frame(
    tmp_path: Path, write_depth: Callable[..., None], cut: int | None, message: str
) -> None:
    write_scannetpp(tmp_path / "scene", LIDAR, 1, write_depth)
    path = tmp_path / "scene/iphone/depth.bin"
    path.write_bytes(path.read_bytes()[:cut])
    errors = []
    for read in open_source(tmp_path / "scene").frames:
        try:
            read()
        except DataError as error:
            errors.append(str(error))
    assert re.search(message, errors[0]), errors


def test_scannetpp_missing_files_raise(tmp_path: Path) -> None:
    write_scannetpp(tmp_path / "scene", FRAMES)
    (tmp_path / "scene/iphone/depth").rename(tmp_path / "depth")
    with pytest.raises(DataError, match=r"depth.bin: expected depth.bin or depth/, got neither; download"):
        open_source(tmp_path / "scene")
    (tmp_path / "scene/iphone/rgb").rename(tmp_path / "rgb")
    with pytest.raises(DataError, match=r"rgb.mp4: expected a readable file"):
        open_source(tmp_path / "scene")
    (tmp_path / "scene/iphone/pose_intrinsic_imu.json").write_text("{}")
    with pytest.raises(DataError, match=r"imu.json: expected keys such as frame_000000, got none in 0 keys"):
        open_source(tmp_path / "scene")
