"""Tests for scans of ARKitScenes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.formats import open_source
from framework.sensors.noise_models import SensorKind
from tests.support.recordings.arkit_scenes_files import VIDEO, write_arkit_scenes
from tests.support.recordings.phone_exports import write_png
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, imported

FRAMES = desk_frames()


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    folder = tmp_path / f"{VIDEO}/{VIDEO}_frames"
    write_arkit_scenes(folder, FRAMES)
    return folder


def test_arkit_scenes_desk_round_trip_preserves_frames(scan: Path, tmp_path: Path) -> None:
    assert not imported(scan.parent, tmp_path / "out")  # the folder of the video, as in the 3dod dataset
    sequence = RgbdFolder(tmp_path / "out")
    assert sequence.sensor_kind is SensorKind.PHONE_LIDAR
    check_round_trip(FRAMES, sequence, time_tolerance=1.1e-3)  # names have three decimals
    for frame, seen in zip(FRAMES, sequence, strict=True):
        np.testing.assert_allclose(frame.T_world_camera[:3, :3] @ seen.up, [0, 0, 1], atol=1e-6)


def test_arkit_scenes_published_lines_give_known_values(tmp_path: Path) -> None:
    """Names and lines of the documentation.

    Sources: DATA.md describes the columns of .pincam and .traj; the names are those of tenFpsDataLoader.py. The camera
    is at (1, 2, 3) and turned by 90 degrees about z, so T_camera_world has the translation -R^T t.
    """
    (tmp_path / "lowres_wide_intrinsics").mkdir()
    (tmp_path / "lowres_wide_intrinsics/41069021_309.299.pincam").write_text("256 192 212.027 212.027 127.933 95.9333")
    (tmp_path / "lowres_wide.traj").write_text(
        "309.19982729 0 0 0 0 0 0\n309.29981354 0.0 0.0 -1.5707963267948966 -2.0 1.0 -3.0\n"
    )
    write_png(tmp_path / "lowres_wide/41069021_309.300.png", np.full((192, 256, 3), 90, np.uint8))
    write_png(tmp_path / "lowres_depth/41069021_309.300.png", np.full((192, 256), 1234, np.uint16))
    [read] = open_source(tmp_path).frames
    frame = read()
    assert frame.timestamp == pytest.approx(309.3)
    assert frame.camera == Camera(256, 192, 212.027, 212.027, 127.933, 95.9333)
    assert frame.depth[0, 0] == np.float32(1.234)
    assert frame.confidence is None
    np.testing.assert_allclose(
        frame.T_world_camera, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
    )


def test_arkit_scenes_image_without_pose_is_skipped(scan: Path, tmp_path: Path) -> None:
    lines = (scan / "lowres_wide.traj").read_text().splitlines()
    (scan / "lowres_wide.traj").write_text("\n".join(lines[:1] + lines[2:]))
    [error] = imported(scan, tmp_path / "out")
    assert re.search(r"lowres_wide/41069021_.*png: expected a pose within 0.005 s in .*traj, got the nearest", error)
    check_round_trip(FRAMES[::2], RgbdFolder(tmp_path / "out"), time_tolerance=1.1e-3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("lowres_wide.traj", "", "expected poses, got an empty file"),
        ("lowres_wide.traj", "1 2 3\n", "line 1: expected 7 numbers .*, got 3"),
        ("lowres_wide.traj", "nan 0 0 0 0 0 0\n", "line 1: expected a finite timestamp, got 'nan'"),
    ],
)
def test_arkit_scenes_invalid_trajectory_raises(scan: Path, name: str, content: str, message: str) -> None:
    (scan / name).write_text(content)
    with pytest.raises(DataError, match=f"{name}.*{message}"):
        open_source(scan)


@pytest.mark.parametrize("folder", ["lowres_depth", "lowres_wide_intrinsics"])
def test_arkit_scenes_missing_asset_raises(scan: Path, tmp_path: Path, folder: str) -> None:
    (scan / folder).rename(tmp_path / "moved")
    with pytest.raises(DataError, match=f"{folder}: expected files such as 41069021_309.300.* download this asset"):
        open_source(scan)


@pytest.mark.parametrize(
    ("folder", "content", "message"),
    [
        ("lowres_wide_intrinsics", b"256 192 nan 212 127 95", "pincam: Camera: expected positive fx, fy"),
        ("lowres_wide_intrinsics", b"nan 192 212 212 127 95", "pincam: width, height: expected whole numbers of px"),
        ("lowres_wide_intrinsics", b"212 212 127 95", "pincam: expected 6 numbers .width height fx fy cx cy., got 4"),
        ("lowres_depth", b"", "png: expected an image, got an empty file"),
        ("lowres_wide", None, ""),
        ("confidence", None, "lowres_wide/.*png: expected a file within 0.001 s in confidence/, got none"),
    ],
)
def test_arkit_scenes_damaged_file_skips_one_frame(
    scan: Path, tmp_path: Path, folder: str, content: bytes | None, message: str
) -> None:
    path = sorted((scan / folder).iterdir())[1]
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    errors = imported(scan, tmp_path / "out")
    assert len(errors) == bool(message)
    assert all(re.search(message, error) for error in errors), errors
    assert len(RgbdFolder(tmp_path / "out")) == 2
