"""Tests for Record3D, with EXR exports, .r3d files and a real export."""

from __future__ import annotations

import json
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from framework.importing.phones.image_rotation import Turn, upright
from tests.support.recordings.phone_exports import (
    check_imported,
    record3d_metadata,
    room_frames,
    write_r3d,
    write_record3d_exr,
)

FRAMES = room_frames()
REAL_FRAMES = 4  # number of frames with images; the metadata lists 345 frames


@pytest.fixture
def export(tmp_path: Path) -> Path:
    pytest.importorskip("OpenEXR")
    write_record3d_exr(tmp_path / "export", FRAMES)
    return tmp_path / "export"


@pytest.fixture
def r3d(tmp_path: Path) -> Path:
    pytest.importorskip("lzfse")
    write_r3d(tmp_path / "room.r3d", FRAMES)
    return tmp_path / "room.r3d"


def test_record3d_exr_export_matches_room_geometry(export: Path, tmp_path: Path) -> None:
    write_folder(open_source(export), tmp_path / "out", Writing())
    check_imported(tmp_path / "out", FRAMES, least=0)  # the export has no confidence


@pytest.mark.parametrize("least", [0, 1, 2])
def test_record3d_r3d_file_matches_room_geometry(r3d: Path, tmp_path: Path, least: int) -> None:
    write_folder(open_source(r3d), tmp_path / "out", Writing(width=160, confidence=least))
    check_imported(tmp_path / "out", FRAMES, 0.5, least)


def test_record3d_r3d_without_confidence_keeps_all_depth(tmp_path: Path) -> None:
    pytest.importorskip("lzfse")
    write_r3d(tmp_path / "room.r3d", FRAMES, confident=False)
    write_folder(open_source(tmp_path / "room.r3d"), tmp_path / "out", Writing(confidence=2))
    check_imported(tmp_path / "out", FRAMES, least=0)


def test_record3d_older_export_uses_common_camera_and_rate(export: Path, tmp_path: Path) -> None:
    metadata = record3d_metadata(FRAMES, own_intrinsics=False)
    del metadata["frameTimestamps"]
    (export / "metadata.json").write_text(json.dumps(metadata))
    write_folder(open_source(export), tmp_path / "out", Writing())
    sequence = RgbdFolder(tmp_path / "out")
    assert sequence.camera == FRAMES[0].camera
    assert [frame.timestamp for frame in sequence] == pytest.approx([k / 30 for k in range(4)])


def test_record3d_identity_first_pose_writes_no_gravity_file(export: Path, tmp_path: Path) -> None:
    """In 2022 the app wrote poses relative to the first frame. They do not contain the gravity direction."""
    changed(export, lambda m: m["poses"].__setitem__(0, [0, 0, 0, 1, 0, 0, 0]))
    write_folder(open_source(export), tmp_path / "out", Writing())
    assert len(RgbdFolder(tmp_path / "out")) == 4
    assert not (tmp_path / "out/gravity.txt").exists()


def test_record3d_zero_poses_count_as_none(export: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    changed(export, lambda m: m.update(poses=[[0.0] * 7] * 4))
    assert not write_folder(open_source(export), tmp_path / "out", Writing()).errors
    assert not (tmp_path / "out/poses.txt").exists()
    found = [frame.timestamp for frame in RgbdFolder(tmp_path / "out")]
    assert found == pytest.approx([frame.timestamp for frame in FRAMES], abs=1e-6)
    assert "expected camera poses, got only zeros; imported without poses" in caplog.text


def changed(export: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    metadata = record3d_metadata(FRAMES)
    change(metadata)
    (export / "metadata.json").write_text(json.dumps(metadata))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda m: m["poses"].__setitem__(1, [0, 0, 0, 2, 0, 0, 0]),
            "pose 1: expected a quaternion .* of length 1, got 2",
        ),
        (lambda m: m["poses"].__setitem__(1, [0] * 7), "expected a pose, got none; --poses none"),
        (lambda m: m["poses"].__setitem__(1, [0, 0, 0, 1]), "pose 1: expected a list of 7 numbers"),
        (lambda m: m["poses"].__setitem__(1, [None] * 7), "pose 1: expected a list of 7 numbers"),
        (lambda m: m["frameTimestamps"].__setitem__(1, 0.0), "expected a timestamp > "),
    ],
)
def test_record3d_damaged_pose_skips_one_frame(export: Path, tmp_path: Path, change, message: str) -> None:
    changed(export, change)
    written = write_folder(open_source(export), tmp_path / "out", Writing())
    [fault] = written.errors
    assert re.search(message, fault)
    assert len(RgbdFolder(tmp_path / "out")) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("poses"), "poses: expected a list of poses, got None"),
        (lambda m: m.update(poses=[]), "poses: expected a list of poses"),
        (lambda m: (m.pop("perFrameIntrinsicCoeffs"), m.pop("K")), "K: expected a list of 9 numbers"),
        (lambda m: m.update(w="640"), "w: expected a number, got '640'"),
        (lambda m: m.update(w=10**9), "Camera: expected an image of at most"),
        (lambda m: m.update(dw=0.5), "width, height: expected whole numbers of px"),
        (lambda m: m.update(dw=10**9), "Camera: expected an image of at most"),
        (lambda m: m.update(frameTimestamps=[1, 2]), "frameTimestamps: expected a list of 4 numbers"),
        (lambda m: (m.pop("frameTimestamps"), m.update(fps=0)), "fps: expected a value > 0 Hz"),
    ],
)
def test_record3d_invalid_metadata_raises(export: Path, change, message: str) -> None:
    changed(export, change)
    with pytest.raises(DataError, match=rf"metadata\.json: .*{message}|metadata\.json: {message}"):
        open_source(export)


@pytest.mark.parametrize("spoil", [lambda data: data[:1000], lambda data: b"", lambda data: data[:300] + data[400:]])
def test_record3d_damaged_exr_image_skips_one_frame(export: Path, tmp_path: Path, spoil) -> None:
    path = export / "depth/1.exr"
    path.write_bytes(spoil(path.read_bytes()))
    written = write_folder(open_source(export), tmp_path / "out", Writing())
    [fault] = written.errors
    assert "depth/1.exr" in fault


def test_record3d_depth_size_mismatch_raises(export: Path, tmp_path: Path) -> None:
    changed(export, lambda m: m.update(dw=1000))
    with pytest.raises(DataError, match=r"depth/0\.exr: expected 1000x60 px with the channel R, got 80x60 px with R"):
        write_folder(open_source(export), tmp_path / "out", Writing())


def rewritten(r3d: Path, name: str, content: bytes | None) -> Path:
    path = r3d.with_name("damaged.r3d")
    with zipfile.ZipFile(r3d) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for member in old.namelist():
            if member != name:
                new.writestr(member, old.read(member))
            elif content is not None:
                new.writestr(member, content)
    return path


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rgbd/1.depth", None, r"expected rgbd/1\.depth, got no such member"),
        ("rgbd/1.depth", b"bvx2" + bytes(100), r"rgbd/1\.depth: expected LZFSE data"),
        ("rgbd/1.depth", bytes(10**6), r"rgbd/1\.depth: expected at most .* bytes, got 1000000"),
        ("rgbd/1.depth", b"bvx2" * 100, r"rgbd/1\.depth: expected at most 8 LZFSE blocks for 19200 bytes, got 100"),
        ("rgbd/1.jpg", b"\xff\xd8\xff", r"rgbd/1\.jpg: expected an image with an end marker"),
        ("rgbd/1.conf", b"", r"rgbd/1\.conf: expected LZFSE data"),
    ],
)
def test_record3d_damaged_r3d_member_skips_one_frame(
    r3d: Path, tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    written = write_folder(open_source(rewritten(r3d, name, content)), tmp_path / "out", Writing())
    [fault] = written.errors
    assert re.search(message, fault), fault
    assert len(RgbdFolder(tmp_path / "out")) == 3


def test_record3d_decompression_bomb_skips_its_frame(r3d: Path, tmp_path: Path) -> None:
    lzfse = pytest.importorskip("lzfse")
    packed = lzfse.compress(bytes(10**6))
    bomb = 100 * packed[:-4] + packed[-4:]  # the last four bytes mark the end of the stream
    written = write_folder(open_source(rewritten(r3d, "rgbd/1.depth", bomb)), tmp_path / "out", Writing())
    assert re.search("expected at most .* (bytes|LZFSE blocks)", written.errors[0])


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no zip at all" * 100])
def test_record3d_r3d_file_other_than_zip_raises(tmp_path: Path, content: bytes) -> None:
    pytest.importorskip("lzfse")
    (tmp_path / "room.r3d").write_bytes(content)
    with pytest.raises(DataError, match=r"room\.r3d: expected a zip archive, got an error \(File is not a zip file"):
        open_source(tmp_path / "room.r3d")


@pytest.mark.parametrize(("module", "source"), [("OpenEXR", "export"), ("lzfse", "r3d")])
def test_record3d_missing_package_error_names_extra(
    module: str, source: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = request.getfixturevalue(source)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=r"expected an installed package \(it .*\), got none"):
        open_source(path)


def test_record3d_real_export_is_imported(shared_data: Path, tmp_path: Path) -> None:
    pytest.importorskip("OpenEXR")
    original = shared_data / "originals" / "record3d" / "EXR_RGBD"
    if not original.is_dir():
        pytest.skip(f"{original} does not exist")
    written = write_folder(open_source(original), tmp_path / "out", Writing())
    assert (len(written.timestamps), len(written.errors)) == (REAL_FRAMES, 345 - REAL_FRAMES)
    sequence = RgbdFolder(tmp_path / "out")
    assert (sequence.camera.width, sequence.camera.height) == (480, 640)
    assert sequence.camera.fx == pytest.approx(1404.302978515625 / 3)
    assert sequence.camera.cx == pytest.approx((724.6458740234375 + 0.5) / 3 - 0.5)
    frame = sequence[3]
    assert frame.timestamp == pytest.approx(0.05000420800206484)
    assert (frame.depth > 0).mean() > 0.99
    assert np.median(frame.depth) == pytest.approx(0.247, abs=0.003)
    # the camera looks at a door handle, 50 degrees below the horizon
    T_world_camera = frame.T_world_camera
    assert T_world_camera is not None
    assert T_world_camera[1, 2] == pytest.approx(-0.77, abs=0.02)
    assert T_world_camera[1, 1] < -0.6
    assert upright(written.ups) == Turn(0)
    np.testing.assert_allclose(frame.up, T_world_camera[1, :3], atol=1e-6)
