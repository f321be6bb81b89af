"""Tests for ScanNet scans in the layout posed_images, with one intrinsics file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.scannet.scannet import ScanNet
from framework.errors import DataError, FrameError
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames
from tests.support.recordings.scannet_files import Shot, intrinsics, write_posed_images

FRAMES = tuple(replace(frame, timestamp=k / 30) for k, frame in enumerate(desk_frames()))
SHOTS = [Shot(frame.color, frame.depth_mm, frame.T_world_camera) for frame in FRAMES]
CAMERA = FRAMES[0].camera
LARGE = Camera(1296, 968, 1170.187988, 1170.187988, 647.750000, 483.750000)  # of scene0000_00, as published


def test_posed_images_desk_round_trip_preserves_frames(tmp_path: Path) -> None:
    write_posed_images(tmp_path / "scene0000_00", SHOTS, CAMERA)
    scan = ScanNet(tmp_path, "scene0000_00")
    check_round_trip(FRAMES, scan, pose_tolerance=1e-5)  # matrices have six decimals


def large() -> list[Shot]:
    return [replace(shot, color=cv2.resize(shot.color, (LARGE.width, LARGE.height))) for shot in SHOTS]


def test_posed_images_color_intrinsics_give_depth_camera(tmp_path: Path) -> None:
    """The published intrinsics of depth (640x480) in scene0000_00 are 577.870605, 577.870605, 319.5, 239.5."""
    write_posed_images(tmp_path, large(), LARGE)
    camera = ScanNet(tmp_path).camera
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], 577.87, rtol=5e-3)
    np.testing.assert_allclose(camera.K[:2, 2], [319.5, 239.5], atol=1)


def test_posed_images_depth_intrinsics_take_precedence(tmp_path: Path) -> None:
    write_posed_images(tmp_path, large(), LARGE)
    depth = Camera(640, 480, 577.870605, 577.870605, 319.5, 239.5)
    np.savetxt(tmp_path / "depth_intrinsic.txt", intrinsics(depth), fmt="%f")
    assert ScanNet(tmp_path).camera == depth


def test_posed_images_intrinsics_of_depth_are_recognized(tmp_path: Path) -> None:
    """The principal point shows to which image the only intrinsics belong."""
    write_posed_images(tmp_path, large(), CAMERA)
    assert ScanNet(tmp_path).camera == CAMERA


def test_posed_images_intrinsics_of_other_images_raise(tmp_path: Path) -> None:
    write_posed_images(tmp_path, SHOTS, Camera(2000, 1500, 1800.0, 1800.0, 1000.0, 750.0))
    with pytest.raises(
        DataError, match=r"intrinsic.txt: expected intrinsics for images of 640x480 px, got cx, cy = 1000"
    ):
        ScanNet(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("00001.txt", "-inf -inf -inf -inf\n" * 4, "00001.txt: pose: expected finite values"),
        ("00001.txt", "1 2 3\n", "00001.txt: expected 4 lines of 4 numbers, got 1"),
        ("00001.png", "", "00001.png: expected an image, got an empty file"),
        ("00001.txt", None, "00001.txt: expected a text file, got no such file"),
        ("00001.jpg", None, "00001.jpg: expected a readable file"),
    ],
)
def test_posed_images_damaged_frame_is_skipped(tmp_path: Path, name: str, content: str | None, message: str) -> None:
    write_posed_images(tmp_path, SHOTS, CAMERA)
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(content)
    scan = ScanNet(tmp_path)
    with pytest.raises(FrameError, match=message):
        scan[1]
    check_round_trip(FRAMES[::2], [scan[0], scan[2]], pose_tolerance=1e-5)


@pytest.mark.parametrize(("suffix", "kind"), [("jpg", r"\.jpg, \.jpeg"), ("png", r"\.png")])
def test_posed_images_without_images_raise(tmp_path: Path, suffix: str, kind: str) -> None:
    write_posed_images(tmp_path, SHOTS, CAMERA)
    for path in tmp_path.glob(f"*.{suffix}"):
        path.unlink()
    with pytest.raises(DataError, match=rf"expected files \({kind}\), got "):
        ScanNet(tmp_path)
