"""Tests for recordings of Stray Scanner, with damaged folders and a real recording."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from framework.importing.phones import stray_scanner
from framework.importing.phones.image_rotation import Turn, upright
from tests.support.recordings.phone_exports import check_imported, room_frames, write_stray_scanner, write_video

FRAMES = room_frames()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_stray_scanner(tmp_path / "export", FRAMES)
    return tmp_path / "export"


@pytest.mark.parametrize(("width", "scale"), [(0, 1.0), (160, 0.5), (1000, 1.0)])
def test_stray_scanner_export_matches_room_geometry(folder: Path, tmp_path: Path, width: int, scale: float) -> None:
    written = write_folder(open_source(folder), tmp_path / "out", Writing(width=width))
    assert str(written) == "4 frames"
    check_imported(tmp_path / "out", FRAMES, scale)


@pytest.mark.parametrize("least", [0, 1, 2])
def test_stray_scanner_drops_low_confidence_depth(folder: Path, tmp_path: Path, least: int) -> None:
    write_folder(open_source(folder), tmp_path / "out", Writing(confidence=least))
    check_imported(tmp_path / "out", FRAMES, least=least)


def test_stray_scanner_older_export_uses_common_intrinsics(tmp_path: Path) -> None:
    frames = [FRAMES[0]]
    write_stray_scanner(tmp_path / "old", frames, own_intrinsics=False)
    write_folder(open_source(tmp_path / "old"), tmp_path / "out", Writing())
    check_imported(tmp_path / "out", frames)


def test_stray_scanner_stride_two_imports_alternate_frames(folder: Path, tmp_path: Path) -> None:
    write_folder(open_source(folder), tmp_path / "out", Writing(stride=2))
    sequence = RgbdFolder(tmp_path / "out")
    assert [frame.timestamp for frame in sequence] == pytest.approx([FRAMES[0].timestamp, FRAMES[2].timestamp])
    assert sorted(path.name for path in (tmp_path / "out/color").iterdir()) == ["000000.jpg", "000002.jpg"]
    assert np.abs(sequence[1].color.astype(int) - FRAMES[2].color).mean() < 12


def spoil_row(folder: Path, number: int, change) -> None:
    path = folder / "odometry.csv"
    lines = path.read_text().splitlines()
    words = lines[number].split(",")
    lines[number] = ",".join(change(words))
    path.write_text("\n".join(lines) + "\n")


def test_stray_scanner_zero_poses_count_as_none(folder: Path, tmp_path: Path) -> None:
    for number in range(1, len((folder / "odometry.csv").read_text().splitlines())):
        spoil_row(folder, number, lambda words: [*words[:2], *["0.0"] * 7, *words[9:]])
    assert not write_folder(open_source(folder), tmp_path / "out", Writing()).errors
    assert not (tmp_path / "out/poses.txt").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda words: words[:5], r"odometry.csv, line 3: expected 9 numbers .* got 5"),
        (lambda words: [*words[:2], " nan", *words[3:]], r"odometry.csv, line 3: expected a finite pose"),
        (
            lambda words: [*words[:8], " 7.0", *words[9:]],
            r"odometry.csv, line 3: expected a quaternion .* of length 1, got 7",
        ),
        (
            lambda words: [words[0], " 1.5", *words[2:]],
            r"odometry.csv, line 3: frame: expected an integer from 0 to 999999, got '1.5'",
        ),
        (
            lambda words: [words[0], " 000077", *words[2:]],
            r"rgb.mp4: expected frame 77, got the end of the readable video",
        ),
        (lambda words: ["99.0", *words[1:]], r"000001.png: expected a timestamp > .* s, got 99.000000 s"),
        (
            lambda words: [*words[:9], " -5.0", *words[10:]],
            "line 3: Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy =",
        ),
    ],
)
def test_stray_scanner_damaged_odometry_row_skips_its_frame(folder: Path, tmp_path: Path, change, message: str) -> None:
    spoil_row(folder, 2, change)
    written = write_folder(open_source(folder), tmp_path / "out", Writing())
    [fault] = written.errors if "77" not in message else written.errors[:1]
    assert re.search(message, fault), fault
    assert len(RgbdFolder(tmp_path / "out")) == len(written.timestamps)


@pytest.mark.parametrize("name", ["depth/000002.png", "confidence/000002.png"])
def test_stray_scanner_damaged_image_skips_one_frame(folder: Path, tmp_path: Path, name: str) -> None:
    path = folder / name
    path.write_bytes(path.read_bytes()[:-20])
    written = write_folder(open_source(folder), tmp_path / "out", Writing())
    assert len(written.timestamps) == 3
    assert name in written.errors[0]
    assert "skipped 1, first error: " in str(written)
    path.unlink()
    assert len(write_folder(open_source(folder), tmp_path / "again", Writing()).timestamps) == 3


def test_stray_scanner_short_video_keeps_decoded_frames(folder: Path, tmp_path: Path) -> None:
    write_video(folder / "rgb.mp4", [frame.color for frame in FRAMES[:2]])
    written = write_folder(open_source(folder), tmp_path / "out", Writing())
    assert (len(written.timestamps), len(written.errors)) == (2, 2)
    assert "rgb.mp4: expected frame 2, got the end of the readable video" in written.errors[0]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rgb.mp4", None, r"rgb\.mp4: expected a readable file"),
        ("rgb.mp4", b"#EXTM3U\nhttp://localhost/1.ts\n", r"rgb\.mp4: expected an MP4 or QuickTime file"),
        ("rgb.mp4", b"\0\0\0\x18ftypmp42" + bytes(200), r"rgb\.mp4: expected a video in a codec"),
        ("odometry.csv", b"", r"odometry\.csv, line 1: expected columns timestamp, frame"),
        ("odometry.csv", b"1, 2, 3, 4\n", r"odometry\.csv, line 1: expected"),
        ("odometry.csv", b"timestamp, frame, x, y, z, qx, qy, qz, qw\n", "the recording has no frames"),
        ("camera_matrix.csv", b"1, 0, 2\n0, 1, 2\n", r"camera_matrix\.csv: expected 3 lines"),
        ("camera_matrix.csv", b"1, 0, 2\n0, x, 2\n0, 0, 1\n", r"camera_matrix\.csv, line 2: .* got ' x'"),
    ],
)
def test_stray_scanner_invalid_export_leaves_no_folder(
    folder: Path, tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    with pytest.raises(DataError, match=message):
        write_folder(stray_scanner.open_source(folder), tmp_path / "out", Writing())
    assert not (tmp_path / "out").exists()


def test_stray_scanner_real_recording_is_imported(shared_data: Path, tmp_path: Path) -> None:
    """The recording is real except for the video, which has random images."""
    original = shared_data / "originals" / "stray_scanner"
    if not original.is_dir():
        pytest.skip(f"{original} does not exist")
    for name in ("depth", "confidence"):
        shutil.copytree(original / name, tmp_path / "export" / name)
    for name in ("odometry.csv", "camera_matrix.csv"):
        shutil.copy(original / name, tmp_path / "export" / name)
    rng = np.random.default_rng(0)
    write_video(tmp_path / "export/rgb.mp4", rng.integers(0, 255, (4, 1440, 1920, 3)).astype(np.uint8))
    written = write_folder(open_source(tmp_path / "export"), tmp_path / "out", Writing())
    sequence = RgbdFolder(tmp_path / "out")
    assert (sequence.camera.width, sequence.camera.height) == (640, 480)
    assert sequence.camera.fx == pytest.approx(1327.616 / 3)
    assert sequence.camera.cx == pytest.approx((969.81036 + 0.5) / 3 - 0.5)
    assert len(sequence) == 4
    assert len(written.errors) == len((original / "odometry.csv").read_text().splitlines()) - 1 - 4
    depth = sequence[0].depth
    assert (depth > 0).mean() == pytest.approx(1 - 8939 / (192 * 256), abs=0.01)  # 8939 pixels have confidence 0
    assert np.median(depth[depth > 0]) == pytest.approx(2.72, abs=0.05)
    # in the accelerometer data, 0.20 of gravity is along the optical axis: the camera looks down
    assert sequence[0].T_world_camera[1, 2] == pytest.approx(-0.24, abs=0.01)
    assert upright(written.ups) == Turn(1)  # the phone was held upright
    # the acceleration of Core Motion points down at rest; x, y, z of the camera are -y, -x, -z of the phone
    rows = [line.split(",") for line in (original / "imu.csv").read_text().splitlines()[1:]]
    x, y, z = -np.mean([[float(word) for word in row[1:4]] for row in rows if float(row[0]) < 248630.7], axis=0)
    measured = np.array([-y, -x, -z]) / np.linalg.norm([x, y, z])
    assert np.degrees(np.arccos(sequence[0].up @ measured)) < 3
