"""Tests for folders with a transforms.json."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.formats import open_source
from tests.support.recordings.phone_exports import write_png
from tests.support.recordings.recorded_frames import check_round_trip, desk_frames, imported
from tests.support.recordings.transforms_files import write_nerfcapture, write_nerfstudio

FRAMES = tuple(replace(frame, timestamp=k / 30) for k, frame in enumerate(desk_frames()))


@pytest.mark.parametrize("write", [write_nerfstudio, write_nerfcapture])
def test_transforms_desk_round_trip_preserves_frames(write: Callable[..., None], tmp_path: Path) -> None:
    write(tmp_path / "scene", FRAMES)
    assert not imported(tmp_path / "scene", tmp_path / "out")
    check_round_trip(FRAMES, RgbdFolder(tmp_path / "out"), depth_tolerance=1.1e-3)


def test_transforms_published_example_gives_known_values(tmp_path: Path) -> None:
    """The keys and the axes of the documentation.

    Source: docs/quickstart/data_conventions.md of nerfstudio, with OPENCV instead of OPENCV_FISHEYE, and a camera at
    (1, 2, 3) that looks along -z of the world.
    """
    (tmp_path / "transforms.json").write_text("""{
  "camera_model": "OPENCV", "fl_x": 1072.0, "fl_y": 1068.0, "cx": 150.5, "cy": 100.5, "w": 300, "h": 200,
  "k1": 0.0312, "k2": 0.0051, "p1": 0.0006, "p2": 0.0001, "applied_scale": 2.0,
  "frames": [{"file_path": "images/frame_00001.png", "depth_file_path": "depth/frame_00001.png",
    "transform_matrix": [[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 4.0], [0.0, 0.0, 1.0, 6.0], [0.0, 0.0, 0.0, 1.0]]}]
}""")
    write_png(tmp_path / "images/frame_00001.png", np.full((200, 300, 3), 90, np.uint8))
    write_png(tmp_path / "depth/frame_00001.png", np.full((100, 150), 1234, np.uint16))
    source = open_source(tmp_path / "transforms.json")
    assert source.distortion == Distortion(k1=0.0312, k2=0.0051, p1=0.0006, p2=0.0001)
    [read] = source.frames
    frame = read()
    assert frame.camera == Camera(300, 200, 1072.0, 1068.0, 150.0, 100.0)  # pixel centers at integers
    assert frame.depth.shape == (100, 150)
    assert frame.depth[0, 0] == np.float32(1.234)
    np.testing.assert_allclose(frame.T_world_camera, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])


def test_transforms_timestamps_are_read_in_order(tmp_path: Path) -> None:
    write_nerfcapture(tmp_path / "scene", FRAMES)
    times = [7.5, 7.25, 7.0]

    def add_times(content: dict[str, Any]) -> None:
        for frame, time in zip(content["frames"], times, strict=True):
            frame["timestamp"] = time

    change(tmp_path / "scene", add_times)
    assert not imported(tmp_path / "scene", tmp_path / "out")
    assert [frame.timestamp for frame in RgbdFolder(tmp_path / "out")] == times[::-1]


def as_floats(suffix: str, unit: float) -> Callable[[Path], None]:
    """Return a function that replaces the depth images by float images, with `unit` units per m."""

    def replace_images(folder: Path) -> None:
        for path in sorted((folder / "depth").iterdir()):
            depth = np.float32(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 1000 * unit)
            path.unlink()
            if suffix == ".npy":
                np.save(path.with_suffix(suffix), depth)
            else:
                Image.fromarray(depth).save(path.with_suffix(suffix))
        change(folder, lambda c: [f.update(depth_file_path=f["depth_file_path"][:-4] + suffix) for f in c["frames"]])

    return replace_images


def in_units(unit: float) -> Callable[[Path], None]:
    """Return a function that scales depth to `unit` units per m."""

    def scale(folder: Path) -> None:
        for path in (folder / "depth").iterdir():
            depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.rint(depth * unit / 1000).astype(np.uint16))
        change(folder, lambda c: c.update(depth_unit_scale_factor=1 / unit))

    return scale


def of_each_frame(folder: Path) -> None:
    """Move all intrinsics to the frames, as for cameras with autofocus."""
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "camera_model")
    change(folder, lambda c: [frame.update({key: c[key] for key in keys}) for frame in c["frames"]])
    change(folder, lambda c: [c.pop(key) for key in keys])


VARIANTS: dict[str, Callable[[Path], Any]] = {
    "unit of TUM": in_units(5000.0),
    "unit of Replica": in_units(6553.5),
    "unit of KITTI": in_units(256.0),
    "floats in m": as_floats(".npy", 1.0),
    "TIFF in m": as_floats(".tiff", 1.0),
    "floats in mm": lambda folder: (as_floats(".npy", 1000.0)(folder), change_unit(folder, 0.001)),
    "intrinsics of each frame": of_each_frame,
    "no image size": lambda folder: change(folder, lambda c: (c.pop("w"), c.pop("h"))),
    "frame without depth": lambda folder: change(folder, lambda c: c["frames"].append({"file_path": "images/x.jpg"})),
    "not fisheye": lambda folder: change(folder, lambda c: c.update(is_fisheye=False, aabb_scale=16)),
    "applied scale": lambda folder: change(folder, apply_scale),
    "3x4 matrices": lambda folder: change(folder, lambda c: [f["transform_matrix"].pop() for f in c["frames"]]),
}


def change_unit(folder: Path, unit: float) -> None:
    change(folder, lambda c: c.update(depth_unit_scale_factor=unit))


def apply_scale(content: dict[str, Any]) -> None:
    content["applied_scale"] = 0.25
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 0.25


@pytest.mark.parametrize("name", VARIANTS)
def test_transforms_variant_preserves_frames(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    frames = FRAMES[:2]
    write_nerfstudio(tmp_path / "scene", frames)
    VARIANTS[name](tmp_path / "scene")
    assert not imported(tmp_path / "scene", tmp_path / "out")
    check_round_trip(frames, RgbdFolder(tmp_path / "out"), depth_tolerance=3e-3)
    assert ("1 of 3 frames have no depth" in caplog.text) == (name == "frame without depth")


def test_transforms_float_depth_in_millimeters_names_unit(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path / "scene", FRAMES[:1])
    as_floats(".npy", 1000.0)(tmp_path / "scene")
    with pytest.raises(DataError, match=r"expected float depth in meters, .*; write integer_depth_scale"):
        imported(tmp_path / "scene", tmp_path / "out")


def change(folder: Path, how: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    how(content)
    (folder / "transforms.json").write_text(json.dumps(content))


INVALID = [
    (lambda c: c.update(frames=[]), r"frames: expected a list of frames, got \[\]"),
    (
        lambda c: [f.pop("depth_path") for f in c["frames"]],
        "expected frames with depth_file_path or depth_path, got none",
    ),
    (
        lambda c: c.update(camera_model="OPENCV_FISHEYE"),
        "camera_model: expected OPENCV .*, got 'OPENCV_FISHEYE'; undistort",
    ),
    (lambda c: c["frames"][1].update(k1=0.1), "expected one lens distortion for all frames, got 2; undistort"),
    (lambda c: c.update(k4=0.1), "k4: expected 0 or no such key, got 0.1; undistort"),
    (lambda c: c.update(is_fisheye=True), "is_fisheye: expected false, got True; undistort"),
    (lambda c: c.update(k1="a"), "k1: expected a number, got 'a'"),
    (
        lambda c: c.update(integer_depth_scale=1000),
        r"integer_depth_scale: expected meters per unit in \(0, 1\], got 1000",
    ),
    (
        lambda c: c.update(depth_integer_scale=c.pop("integer_depth_scale")),
        "expected integer_depth_scale .*, got depth_integer_scale of the app's own export",
    ),
    (lambda c: c.update(applied_scale=0), "applied_scale: expected a value > 0, got 0"),
]


@pytest.mark.parametrize(("how", "message"), INVALID)
def test_transforms_invalid_file_raises(tmp_path: Path, how: Callable[..., Any], message: str) -> None:
    write_nerfcapture(tmp_path / "scene", FRAMES)
    change(tmp_path / "scene", how)
    with pytest.raises(DataError, match=f"transforms.json: {message}"):
        open_source(tmp_path / "scene")


DAMAGED = [
    (lambda f: f.update(transform_matrix=[1]), "transform_matrix: expected 4 lists of 4 numbers"),
    (lambda f: f.update(transform_matrix=[[1, 2]] * 4), "transform_matrix: expected a list of 4 numbers"),
    (lambda f: f["transform_matrix"][0].__setitem__(0, 9), "pose: expected a rigid transform"),
    (lambda f: f.update(fl_x=0), "Camera: expected positive fx, fy"),
    (lambda f: f.update(file_path=None), "file_path: expected a file name, got None"),
    (lambda f: f.update(file_path="images/missing.png"), "missing.png: expected a readable file"),
    (lambda f: f.update(depth_path="images/1.png"), "1.png: expected a PNG with 1 channel of uint16, got 4 of uint8"),
]


@pytest.mark.parametrize(("how", "message"), DAMAGED)
def test_transforms_damaged_frame_is_skipped(tmp_path: Path, how: Callable[..., Any], message: str) -> None:
    write_nerfcapture(tmp_path / "scene", FRAMES)
    change(tmp_path / "scene", lambda content: how(content["frames"][1]))
    [error] = imported(tmp_path / "scene", tmp_path / "out")
    assert re.search(message, error), error
    assert len(RgbdFolder(tmp_path / "out")) == 2
