"""Tests for `.sens` files, including truncated files and files with one invalid field."""

from __future__ import annotations

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from framework.datasets.scannet.sens_file import FRAME, MAX_FRAMES, SensFile, open_sens
from framework.errors import DataError, FrameError, StorageError
from tests.support.recordings.scannet_files import (
    COLOR_CAMERA,
    DEPTH_CAMERA,
    JPEG,
    OCCIPITAL,
    PNG,
    RAW,
    ZLIB,
    Shot,
    sens,
    shots,
)

SIZES = 12 + 15 + 4 * 64  # byte offset of the fields after the name and the matrices
HEADER = SIZES + 36


def opened(path: Path, content: bytes) -> SensFile:
    path.write_bytes(content)
    return open_sens(path)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene0000_00.sens"


@pytest.mark.parametrize("compressions", [(PNG, ZLIB), (RAW, RAW), (RAW, ZLIB)])
def test_sens_file_round_trip_is_exact(path: Path, compressions: tuple[int, int]) -> None:
    written = shots()
    file = opened(path, sens(written, compressions=compressions, units=5000))
    header = file.header
    assert (header.color_camera, header.depth_camera) == (COLOR_CAMERA, DEPTH_CAMERA)
    assert (header.depth_scale, header.frames, file.cut) == (5000, 3, "")
    np.testing.assert_array_equal(header.color_extrinsics.values, np.eye(4))
    for k, (frame, shot) in enumerate(zip(file.frames, written, strict=True)):
        assert (frame.number, frame.color_time, frame.depth_time) == (k, *shot.times)
        np.testing.assert_array_equal(frame.camera_to_world.values, shot.T_world_camera.astype(np.float32))
        np.testing.assert_array_equal(frame.color(), shot.color)
        np.testing.assert_array_equal(frame.depth(), shot.depth)
        assert frame.depth().dtype == np.uint16


def test_sens_file_jpeg_color_is_read_as_rgb(path: Path) -> None:
    [frame] = opened(path, sens(shots(1), compressions=(JPEG, ZLIB))).frames
    assert np.abs(frame.color().astype(int) - shots(1)[0].color).mean() < 3


def test_sens_file_is_readable_from_multiple_threads(path: Path) -> None:
    frames = opened(path, sens(shots(6))).frames * 4
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda frame: frame.depth(), frames))
    for frame, depth in zip(frames, found, strict=True):
        np.testing.assert_array_equal(depth, shots(6)[frame.number].depth)


@pytest.mark.parametrize("length", [0, 3, 11, 20, 100, SIZES - 1, SIZES + 10, HEADER - 1])
def test_sens_file_truncated_header_raises(path: Path, length: int) -> None:
    with pytest.raises(
        DataError, match=rf"\.sens, byte \d+: expected a full header, got the end of the file at byte {length}"
    ):
        opened(path, sens(shots())[:length])


@pytest.mark.parametrize(
    ("byte", "replaced", "message"),
    [
        (0, struct.pack("<I", 3), "byte 0: expected version 4 .*, got 3"),
        (4, struct.pack("<Q", 10**18), "byte 4: expected a sensor name of at most 1024 bytes, got 1000000000000000000"),
        (27, struct.pack("<f", np.nan), "byte 27: expected intrinsics"),
        (
            27,
            struct.pack("<f", -1),
            "byte 27: Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy =",
        ),
        (27 + 4, struct.pack("<f", 0.5), "byte 27: expected intrinsics"),
        (
            27 + 2 * 64,
            struct.pack("<f", np.inf),
            "byte 155: Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy =",
        ),
        (SIZES, struct.pack("<i", -1), f"byte {SIZES}: expected a compression of color .* got -1"),
        (SIZES + 4, struct.pack("<i", 7), f"byte {SIZES + 4}: expected a compression of depth .* got 7"),
        (SIZES + 4, struct.pack("<i", OCCIPITAL), f"byte {SIZES + 4}: expected raw or zlib depth, got Occipital's"),
        (SIZES + 8, struct.pack("<I", 2**32 - 1), f"byte {SIZES + 8}: expected color images .*, got 4294967295x49 px"),
        (SIZES + 20, struct.pack("<I", 0), f"byte {SIZES + 8}: expected depth images .*, got 32x0 px"),
        (SIZES + 24, struct.pack("<f", 0), f"byte {SIZES + 24}: depth scale: expected 1 to 1e"),
        (SIZES + 24, struct.pack("<f", np.nan), f"byte {SIZES + 24}: depth scale: expected 1 to 1e"),
        (
            SIZES + 28,
            struct.pack("<Q", 2**64 - 1),
            f"byte {SIZES + 28}: expected at most .* frames .*, got 18446744073709551615",
        ),
        (
            SIZES + 28,
            struct.pack("<Q", MAX_FRAMES),
            f"byte {SIZES + 28}: expected at most .* frames .*, got {MAX_FRAMES}",
        ),
        (
            SIZES + 28,
            struct.pack("<Q", 0),
            r"expected at least one complete frame, got none \(frame count in the header: 0\)",
        ),
    ],
)
def test_sens_file_invalid_header_error_gives_byte_offset(path: Path, byte: int, replaced: bytes, message: str) -> None:
    content = sens(shots())
    with pytest.raises(DataError, match=message) as caught:
        opened(path, content[:byte] + replaced + content[byte + len(replaced) :])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sens_file_excessive_frame_count_raises(path: Path) -> None:
    path.write_bytes(sens(shots(1), count=MAX_FRAMES + 1))
    with path.open("r+b") as file:
        file.truncate((MAX_FRAMES + 100) * FRAME.size)
    with pytest.raises(DataError, match=f"expected at most {MAX_FRAMES} frames in .* bytes, got {MAX_FRAMES + 1}"):
        open_sens(path)


def test_sens_file_truncated_keeps_complete_frames(path: Path) -> None:
    content = sens(shots())
    last = starts(path, content)[2]
    for length in (last, last + 50, last + FRAME.size + 10):
        file = opened(path, content[:length])
        assert (len(file.frames), file.header.frames) == (2, 3)
        assert file.cut == f"byte {last}: the file ends at byte {length}, within frame 2 of 3"


def test_sens_file_excessive_image_size_ends_frame_list(path: Path) -> None:
    content = sens(shots())
    second = starts(path, content)[1]
    for at, claimed in ((80, 2**63), (88, 10**6), (80, 2**64 - 1)):
        byte = second + at
        file = opened(path, content[:byte] + struct.pack("<Q", claimed) + content[byte + 8 :])
        assert len(file.frames) == 1
        assert file.cut.startswith(f"byte {second}: frame 1: expected at most")


def test_sens_file_without_complete_frame_raises(path: Path) -> None:
    with pytest.raises(DataError, match=r"expected at least one complete frame, got none \(byte \d+: the file ends"):
        opened(path, sens(shots())[: HEADER + 3 * FRAME.size])


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (zlib.compress(bytes(10**7)), "expected 1536 bytes after decompression, got at least 1537"),
        (zlib.compress(bytes(1535)), "expected 1536 bytes, got 1535"),
        (zlib.compress(bytes(range(256)) * 6)[:-6], "truncated"),
        (b"\x00" * 100, "expected a valid zlib stream"),
        (b"", "truncated"),
    ],
)
def test_sens_file_invalid_depth_raises_for_its_frame(path: Path, depth: bytes, message: str) -> None:
    good = shots(3)
    file = opened(path, sens([good[0], Shot(good[1].color, depth), good[2]]))
    np.testing.assert_array_equal(file.frames[2].depth(), good[2].depth)
    with pytest.raises(FrameError, match=message) as caught:
        file.frames[1].depth()
    assert f"{path}, depth of frame 1 at byte" in str(caught.value)


@pytest.mark.parametrize("color", [b"", b"\xff\xd8\xff", b"no image at all"])
def test_sens_file_invalid_color_raises_for_its_frame(path: Path, color: bytes) -> None:
    [frame] = opened(path, sens([Shot(color, shots(1)[0].depth)])).frames
    with pytest.raises(FrameError, match="color of frame 0 at byte"):
        frame.color()


def test_sens_file_raw_image_length_mismatch_raises(path: Path) -> None:
    [frame] = opened(path, sens([Shot(bytes(100), bytes(100))], compressions=(RAW, RAW))).frames
    with pytest.raises(FrameError, match="expected 9555 bytes, got 100"):
        frame.color()
    with pytest.raises(FrameError, match="expected 1536 bytes, got 100"):
        frame.depth()


def test_sens_file_frame_of_deleted_file_raises(path: Path) -> None:
    [frame] = opened(path, sens(shots(1))).frames
    path.unlink()
    with pytest.raises(StorageError, match=r"expected a readable file, got an error \(No such file"):
        frame.color()
    with pytest.raises(DataError, match=r"expected a readable file, got an error \(No such file"):
        open_sens(path)


def starts(path: Path, content: bytes) -> list[int]:
    """Return the byte offset of each frame."""
    return [frame.byte - FRAME.size for frame in opened(path, content).frames]
