"""Tests for COLMAP models with RGB-D images."""

from __future__ import annotations

import json
import logging
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.formats import open_source
from tests.support.recordings.colmap_files import write_colmap
from tests.support.recordings.phone_exports import write_png
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, half_size, imported

FRAMES = tuple(replace(frame, timestamp=k / 30) for k, frame in enumerate(desk_frames()))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("unit", [0.37, 1.0, 5.2])
def test_colmap_desk_round_trip_preserves_frames(tmp_path: Path, binary: bool, unit: float, caplog) -> None:
    write_colmap(tmp_path / "scene", FRAMES, unit, binary)
    assert not imported(tmp_path / "scene", tmp_path / "out")
    check_round_trip(FRAMES, RgbdFolder(tmp_path / "out"), pose_tolerance=1e-5)
    assert (f"the unit of the poses is {unit:g} m" in caplog.text) == (unit != 1.0)


def test_colmap_published_text_gives_known_values(tmp_path: Path) -> None:
    """A camera and an image like those of the documentation.

    Source: cameras.txt and images.txt in https://colmap.github.io/format.html, with a smaller image. The quaternion is
    a quarter turn about z, so that the camera is at -R^T t = (-2, 1, -3).
    """
    model = tmp_path / "colmap"
    model.mkdir()
    (model / "cameras.txt").write_text("# Camera list\n1 SIMPLE_RADIAL 64 48 50.0 32 24 -0.01\n")
    (model / "images.txt").write_text(
        "# Image list\n1 0.7071067811865476 0 0 0.7071067811865476 1.0 2.0 3.0 1 P1180141.png\n2362.39 248.498 -1\n"
    )
    (model / "points3D.txt").write_text("# 3D point list\n")
    write_png(tmp_path / "rgb/P1180141.png", np.full((48, 64, 3), 90, np.uint8))
    write_png(tmp_path / "depth/P1180141.png", np.full((48, 64), 1234, np.uint16))
    source = open_source(tmp_path)
    assert source.distortion == Distortion(k1=-0.01)
    [read] = source.frames
    frame = read()
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (50.0, 50.0, 31.5, 23.5)
    assert frame.depth[0, 0] == np.float32(1.234)
    expected = [[0, 1, 0, -2], [-1, 0, 0, 1], [0, 0, 1, -3], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-12)


def test_colmap_without_points_reads_meters(tmp_path: Path, caplog) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 0.5)
    for name in ("images.bin", "points3D.bin"):
        path = tmp_path / "scene/sparse/0" / name
        path.unlink()
    write_colmap(tmp_path / "empty", [replace(f, depth_mm=np.zeros_like(f.depth_mm)) for f in FRAMES], 0.5)
    for name in ("images.bin", "points3D.bin"):
        (tmp_path / "empty/sparse/0" / name).rename(tmp_path / "scene/sparse/0" / name)
    assert not imported(tmp_path / "scene", tmp_path / "out")
    assert (
        "expected at least 50 3D points with depth to determine the unit of the poses, got 0; using 1 m" in caplog.text
    )
    for frame, seen in zip(FRAMES, RgbdFolder(tmp_path / "out"), strict=True):
        np.testing.assert_allclose(seen.T_world_camera[:3, 3], frame.T_world_camera[:3, 3] / 0.5, atol=1e-6)


def test_colmap_depth_scale_of_camera_json_and_small_depth_are_used(tmp_path: Path, caplog) -> None:
    caplog.set_level(logging.WARNING)
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    for k, frame in enumerate(half_size(FRAMES)):
        write_png(tmp_path / f"scene/depth/frame_{k}.png", 5 * frame.depth_mm)
    keys = {"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 0, "cy": 0, "depth_scale": 5000}
    (tmp_path / "scene/camera.json").write_text(json.dumps(keys))
    assert not imported(tmp_path / "scene", tmp_path / "out")
    assert "unit of the poses" not in caplog.text
    for frame, seen in zip(FRAMES, RgbdFolder(tmp_path / "out"), strict=True):
        both = (seen.depth > 0) & (frame.depth_mm > 0)
        assert np.median(np.abs(seen.depth - frame.depth_mm / 1000)[both]) < 0.002


def test_colmap_lens_distortion_is_imported(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0, lens=(0.1, -0.02, 0.001, 0.002))
    assert open_source(tmp_path / "scene").distortion == Distortion(0.1, -0.02, 0.001, 0.002)


def test_colmap_unrelated_depth_raises(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    rng = np.random.default_rng(0)
    for path in (tmp_path / "scene/depth").iterdir():
        write_png(path, rng.integers(200, 9000, FRAMES[0].depth_mm.shape).astype(np.uint16))
    with pytest.raises(
        DataError, match=r"depth: expected depth along z that is proportional .* register depth to color"
    ):
        open_source(tmp_path / "scene")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("kept", [0, 11, -5])
def test_colmap_truncated_binary_file_raises(tmp_path: Path, name: str, kept: int) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    path = tmp_path / f"scene/sparse/0/{name}.bin"
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(
        DataError, match=f"(sparse/0|{name}.bin): expected (complete records|a valid COLMAP model), got"
    ):
        open_source(tmp_path / "scene")


def test_colmap_track_of_impossible_length_raises(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    path = tmp_path / "scene/sparse/0/points3D.bin"
    content = bytearray(path.read_bytes())
    content[8 + 43 : 8 + 51] = b"\xff" * 8  # number of images of the first point
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"points3D.bin: expected complete records, got a file that ends after"):
        open_source(tmp_path / "scene")


def test_colmap_lens_that_does_not_fit_writes_no_folder(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0, lens=(50.0, 0.0, 0.0, 0.0))
    with pytest.raises(DataError, match="expected a shift of at most"):
        imported(tmp_path / "scene", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("OPENCV", "OPENCV_FISHEYE", "camera 1: expected one of SIMPLE_PINHOLE, .*, got OPENCV_FISHEYE; undistort"),
        ("OPENCV", "UNKNOWN", "expected a valid COLMAP model, got an error"),
        ("1 OPENCV", "2 OPENCV", "expected a valid COLMAP model, got an error"),
    ],
)
def test_colmap_invalid_text_model_raises(tmp_path: Path, old: str, new: str, message: str) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0, binary=False)
    path = tmp_path / "scene/sparse/0/cameras.txt"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        open_source(tmp_path / "scene")


def test_colmap_rig_with_two_cameras_raises(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    rig = struct.pack("<QIIiIiIB", 1, 1, 2, 0, 1, 0, 2, 0)
    (tmp_path / "scene/sparse/0/rigs.bin").write_bytes(rig)
    with pytest.raises(DataError, match=r"rigs.bin: expected one camera per rig, got 2; export a model without rigs"):
        open_source(tmp_path / "scene")


def test_colmap_missing_image_skips_one_frame(tmp_path: Path) -> None:
    write_colmap(tmp_path / "scene", FRAMES, 1.0)
    (tmp_path / "scene/images/frame_1.jpg").unlink()
    [error] = imported(tmp_path / "scene", tmp_path / "out")
    assert re.search("images/frame_1.jpg: expected a readable file", error)
    assert len(RgbdFolder(tmp_path / "out")) == 2


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap", "."])
def test_colmap_unregistered_image_is_counted(tmp_path: Path, model: str, caplog: pytest.LogCaptureFixture) -> None:
    scene = tmp_path / "scene"
    write_colmap(scene, FRAMES, unit=1.0)
    shutil.copy(scene / "images/frame_0.jpg", scene / "images/frame_9.jpg")
    for path in list((scene / "sparse/0").iterdir()):
        (scene / model).mkdir(exist_ok=True)
        path.rename(scene / model / path.name)
    assert not imported(scene, tmp_path / "out")
    assert len(RgbdFolder(tmp_path / "out")) == len(FRAMES)
    assert f"1 of {len(FRAMES) + 1} color images have no pose and are skipped" in caplog.text
