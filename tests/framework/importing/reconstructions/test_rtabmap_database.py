"""Tests for RTAB-Map databases."""

from __future__ import annotations

import re
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.formats import open_source
from framework.importing.reconstructions import rtabmap_database
from tests.support.recordings.phone_exports import PhoneFrame
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, half_size, imported
from tests.support.recordings.rtabmap_files import (
    CV_32FC1,
    CV_32SC1,
    T_BASE_CAMERA,
    calibration,
    compressed,
    transform,
    write_rtabmap,
)
from tests.support.recordings.rvl_files import rvl

FRAMES = desk_frames()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_rtabmap(tmp_path / "rtabmap.db", FRAMES)
    return tmp_path / "rtabmap.db"


@pytest.mark.parametrize(("optimized", "float_depth"), [(True, False), (True, True), (False, False)])
def test_rtabmap_desk_round_trip_preserves_frames(tmp_path: Path, optimized: bool, float_depth: bool) -> None:
    write_rtabmap(tmp_path / "my map.db", FRAMES, optimized, float_depth)
    before = (tmp_path / "my map.db").read_bytes()
    assert not imported(tmp_path / "my map.db", tmp_path / "out")
    check_round_trip(FRAMES, RgbdFolder(tmp_path / "out"))
    assert (tmp_path / "my map.db").read_bytes() == before


def test_rtabmap_depth_of_half_resolution_is_resampled(tmp_path: Path) -> None:
    write_rtabmap(tmp_path / "ios.db", half_size(FRAMES))
    assert not imported(tmp_path / "ios.db", tmp_path / "out")
    for frame, seen in zip(FRAMES, RgbdFolder(tmp_path / "out"), strict=True):
        both = (seen.depth > 0) & (frame.depth_mm > 0)
        assert both.mean() > 0.5
        assert np.median(np.abs(seen.depth - frame.depth_mm / 1000)[both]) < 0.002


def test_rtabmap_serialized_calibration_gives_known_values() -> None:
    """The bytes of CameraModel::serialize for a camera with K and a local transform, and no D, R or P.

    Source: introlab/rtabmap, corelib/src/CameraModel.cpp: 11 int32, K as 9 float64, the transform as 12 float32.
    """
    data = bytes.fromhex(
        "00000000 15000000 05000000 00000000 80020000 e0010000 09000000 00000000 00000000 00000000 0c000000"
        "0000000000407f40 0000000000000000 0000000000f07340"  # 500, 0, 319
        "0000000000000000 0000000000507f40 0000000000f06d40"  # 0, 501, 239.5
        "0000000000000000 0000000000000000 000000000000f03f"
        "00000000 00000000 0000803f 0000003f"  # 0, 0, 1, 0.5
        "000080bf 00000000 00000000 00000000"
        "00000000 000080bf 00000000 00000040"
    )
    camera, T_base_camera = rtabmap_database._calibration("node 1", data, (480, 640))
    assert camera == Camera(640, 480, 500.0, 501.0, 319.0, 239.5)
    np.testing.assert_array_equal(T_base_camera, [[0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 2], [0, 0, 0, 1]])


def change(path: Path, statement: str, *values: object) -> None:
    database = sqlite3.connect(path)
    database.execute(statement, values)
    database.commit()
    database.close()


def test_rtabmap_sessions_without_optimized_poses_raise(tmp_path: Path) -> None:
    write_rtabmap(tmp_path / "two.db", FRAMES, optimized=False)
    change(tmp_path / "two.db", "UPDATE Node SET map_id = 1 WHERE id = 3")
    with pytest.raises(DataError, match=r"two.db: expected optimized poses for 2 sessions, got only odometry"):
        open_source(tmp_path / "two.db")


INVALID = [
    ("DELETE FROM Data", (), "expected nodes with color and depth images, got none"),
    ("DROP TABLE Data", (), "expected an RTAB-Map database, got an error .no such table: Data."),
    ("UPDATE Admin SET opt_ids = ?", (b"abc",), "opt_ids: expected a compressed array, got b'abc'"),
    (
        "UPDATE Admin SET opt_ids = ?",
        (compressed(np.array([[1, 2]], "<i4"), CV_32SC1),),
        "opt_poses: expected 24 numbers",
    ),
    (
        "UPDATE Admin SET opt_ids = ?",
        (compressed(np.array([[1.0]], "<f4"), CV_32FC1),),
        "opt_ids: expected an array of type 4",
    ),
    (
        "UPDATE Admin SET opt_poses = ?",
        (b"x" * 20 + struct.pack("<3i", 1, 36, 5),),
        "opt_poses: expected a compressed array",
    ),
    (
        "UPDATE Admin SET opt_poses = ?",
        (zlib.compress(b"1234") + struct.pack("<3i", 1, 36, 5),),
        "opt_poses: expected 144 bytes, got 4",
    ),
]


@pytest.mark.parametrize(("statement", "values", "message"), INVALID)
def test_rtabmap_invalid_database_raises(path: Path, statement: str, values: tuple[object, ...], message: str) -> None:
    change(path, statement, *values)
    with pytest.raises(DataError, match=f"rtabmap.db: {message}"):
        open_source(path)


def test_rtabmap_truncated_database_raises(path: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.db").write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(DataError, match=r"cut.db: expected an RTAB-Map database, got an error"):
        open_source(tmp_path / "cut.db")


def old_calibration(frame: PhoneFrame, has_size: bool) -> bytes:
    c = frame.camera
    size = (c.width, c.height) if has_size else ()
    return struct.pack(f"<{4 + len(size)}f", c.fx, c.fy, c.cx, c.cy, *size) + transform(T_BASE_CAMERA)


def inverse_depth(depth_mm: np.ndarray, encode: Callable[[np.ndarray], bytes]) -> bytes:
    a, b = 150.0 * 151.0, 1.0 - 150.0 * 151.0 / 20.0  # for a quantization of 150 and a range of 20 m
    stored = np.where(depth_mm > 0, np.rint(1000 * a / np.maximum(depth_mm, 1) + b), 0).astype(np.uint16)
    return b"DEPTHINV" + struct.pack("<ff", a, b) + encode(stored)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def rvl_depth(image: np.ndarray) -> bytes:
    return b"DEPTHRVL" + rvl(image)


VERSIONS: dict[str, tuple[str, Callable[[PhoneFrame], bytes]]] = {
    "0.11.0": ("calibration", lambda frame: old_calibration(frame, has_size=False)),
    "0.11.8": ("calibration", lambda frame: old_calibration(frame, has_size=True)),
    "without size": ("calibration", lambda frame: calibration(frame)[:16] + bytes(8) + calibration(frame)[24:]),
    "rvl": ("depth", lambda frame: rvl_depth(frame.depth_mm)),
    "inverse png": ("depth", lambda frame: inverse_depth(frame.depth_mm, png)),
    "inverse rvl": ("depth", lambda frame: inverse_depth(frame.depth_mm, rvl_depth)),
}


@pytest.mark.parametrize("version", VERSIONS)
def test_rtabmap_database_of_version_preserves_frames(path: Path, tmp_path: Path, version: str) -> None:
    """Landmarks have negative ids in the optimized graph. Nodes may have a laser scan only."""
    column, made = VERSIONS[version]
    for number, frame in enumerate(FRAMES, start=1):
        change(path, f"UPDATE Data SET {column} = ? WHERE id = ?", made(frame), number)
    change(path, "INSERT INTO Node (id, map_id, stamp, pose) VALUES (50, 0, 5.0, ?)", transform(np.eye(4)))
    change(path, "INSERT INTO Data (id, scan) VALUES (50, x'01')")
    poses = [frame.T_world_camera @ np.linalg.inv(T_BASE_CAMERA) for frame in FRAMES]
    values = np.array([np.ravel([T[:3] for T in (np.eye(4), *poses)])], "<f4")
    change(path, "UPDATE Admin SET opt_ids = ?", compressed(np.array([[-7, 1, 2, 3]], "<i4"), CV_32SC1))
    change(path, "UPDATE Admin SET opt_poses = ?", compressed(values, CV_32FC1))
    assert not imported(path, tmp_path / "out")
    check_round_trip(FRAMES, RgbdFolder(tmp_path / "out"), depth_tolerance=0.003 if "inverse" in version else 0.0006)


def test_rtabmap_odometry_without_optimization_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_rtabmap(tmp_path / "odometry.db", FRAMES, optimized=False)
    open_source(tmp_path / "odometry.db")
    assert "expected optimized poses, got only odometry, which drifts; open and close the database" in caplog.text


def test_rtabmap_without_poses_is_imported_without_poses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_rtabmap(tmp_path / "odometry.db", FRAMES, optimized=False)
    change(tmp_path / "odometry.db", "UPDATE Node SET pose = ?", bytes(48))
    assert not imported(tmp_path / "odometry.db", tmp_path / "out")
    assert not (tmp_path / "out/poses.txt").exists()
    assert "odometry.db: expected camera poses, got only zeros; imported without poses" in caplog.text


FIRST = calibration(FRAMES[0])
DAMAGED = [
    (
        "UPDATE Data SET depth = ? WHERE id = 2",
        b"DEPTHINV" + bytes(8),
        "depth: expected an image, got an empty",
    ),
    ("UPDATE Data SET depth = ? WHERE id = 2", b"DEPTHRVL" + bytes(8), "node 2: depth: expected an RVL image"),
    ("UPDATE Data SET depth = ? WHERE id = 2", png(FRAMES[0].color), "node 2: depth: .* got 3 of uint8"),
    ("UPDATE Data SET image = ? WHERE id = 2", b"\xff\xd8", "node 2: image: expected an image with an end marker"),
    ("UPDATE Data SET calibration = ? WHERE id = 2", None, "node 2: calibration: expected a blob of .*, got NoneType"),
    (
        "UPDATE Data SET calibration = ? WHERE id = 2",
        b"1",
        "calibration: expected .* one rectified camera, got 1 bytes",
    ),
    ("UPDATE Data SET calibration = ? WHERE id = 2", 2 * FIRST, "got .* bytes; several cameras are not supported"),
    ("UPDATE Data SET calibration = ? WHERE id = 2", FIRST[:12] + b"\1" + FIRST[13:], "got type 1; only single RGB-D"),
    (
        "UPDATE Data SET calibration = ? WHERE id = 2",
        struct.pack("<19f", *[300.0] * 19),
        "got 76 bytes; only",
    ),
    (
        "UPDATE Data SET calibration = ? WHERE id = 2",
        2 * old_calibration(FRAMES[0], True),
        "got 144 bytes; only",
    ),
    (
        "UPDATE Data SET calibration = ? WHERE id = 2",
        FIRST[:-48] + bytes(48),
        "calibration: pose: expected a rigid transform",
    ),
    (
        "UPDATE Data SET calibration = ? WHERE id = 2",
        FIRST[:24] + bytes(4) + FIRST[28:],
        "got 0, 5, 9, 12 and 12 values of K",
    ),
    ("UPDATE Node SET stamp = ? WHERE id = 2", "now", "node 2: stamp: expected a time in s, got 'now'"),
]


@pytest.mark.parametrize(("statement", "value", "message"), DAMAGED)
def test_rtabmap_damaged_node_is_skipped(
    path: Path, tmp_path: Path, statement: str, value: object, message: str
) -> None:
    change(path, statement, value)
    [error] = imported(path, tmp_path / "out")
    assert re.search(message, error), error
    assert len(RgbdFolder(tmp_path / "out")) == 2


@pytest.mark.parametrize("pose", [None, bytes(48), b"123", struct.pack("<12f", *range(12))])
def test_rtabmap_node_without_pose_is_skipped(tmp_path: Path, pose: bytes | None) -> None:
    write_rtabmap(tmp_path / "odometry.db", FRAMES, optimized=False)
    change(tmp_path / "odometry.db", "UPDATE Node SET pose = ? WHERE id = 2", pose)
    [error] = imported(tmp_path / "odometry.db", tmp_path / "out")
    assert re.search("node 2: (pose: expected (12 float32|a rigid transform)|expected a pose, got none)", error), error


def test_rtabmap_node_outside_of_optimized_graph_is_skipped(path: Path, tmp_path: Path) -> None:
    change(path, "UPDATE Admin SET opt_ids = ?", compressed(np.array([[1, 7, 3]], "<i4"), CV_32SC1))
    [error] = imported(path, tmp_path / "out")
    assert re.search("node 2: expected a pose, got none; --poses none imports without poses", error), error


def test_rtabmap_other_file_with_suffix_db_is_not_recognized(tmp_path: Path) -> None:
    (tmp_path / "thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
    with pytest.raises(DataError, match=r"thumbs.db: expected a supported format .*, got an unknown format"):
        open_source(tmp_path / "thumbs.db")
