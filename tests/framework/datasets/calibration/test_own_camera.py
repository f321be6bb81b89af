"""Tests for calibrations next to the images of a recording in the layout of a published dataset.

The files are written as in the documentation of the programs that are named in the parameters.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.calibration.own_camera import own_camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import DepthReading
from framework.datasets.icl_nuim import IclNuim
from framework.datasets.replica_nice_slam import ReplicaNiceSlam
from framework.datasets.scenenn.scenenn import SceneNN
from framework.datasets.seven_scenes import SevenScenes
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import DataError
from tests.support.recordings.recordings import write_color, write_depth

CAMERA = Camera(320, 240, 300, 301, 158, 121)
LENS = Distortion(0.1, -0.2, 0.001, -0.002, 0.0)
K = "300 0 158\n0 301 121\n0 0 1\n"
INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = {color.width}
m_colorHeight = {color.height}
m_depthWidth = 320
m_depthHeight = 240
m_depthShift = 1000
m_calibrationColorIntrinsic = {color.fx} 0 {color.cx} 0 0 {color.fy} {color.cy} 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 300 0 158 0 0 301 121 0 0 0 1 0 0 0 0 1
m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = 2
"""
ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 300.0
Camera.fy: 301.0
Camera.cx: 158.0
Camera.cy: 121.0
Camera.k1: 0.1
Camera.k2: -0.2
Camera.p1: 0.001
Camera.p2: -0.002
Camera.k3: 0.0
Camera.bf: 40.0
DepthMapFactor: 2000.0
"""
CAMERA_INFO = """image_width: 320
image_height: 240
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [300.0, 0.0, 158.0, 0.0, 301.0, 121.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""
OPENCV = """%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 3.0e+02, 0., 1.58e+02, 0.,
       3.01e+02, 1.21e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 1.0e-01, -2.0e-01, 1.0e-03, -2.0e-03, 0. ]
"""
OPEN3D = {"width": 320, "height": 240, "intrinsic_matrix": [300, 0, 0, 0, 301, 0, 158, 121, 1]}
OWN = {"width": 320, "height": 240, "fx": 300, "fy": 301, "cx": 158, "cy": 121, "depth_scale": 2000}
FILES: dict[str, tuple[str, str, Distortion | None, float]] = {
    "InstanceMap": ("camera.json", json.dumps(OWN), None, 2000),
    "NumPy": (
        "cam_K.txt",
        "3.0e+02 0.0e+00 1.58e+02\n0.0e+00 3.01e+02 1.21e+02\n0.0e+00 0.0e+00 1.0e+00",
        None,
        500,
    ),
    "matrix with commas": ("intrinsics.txt", K.replace(" ", ", "), None, 500),
    "ScanNet": ("intrinsic/intrinsic_color.txt", "300 0 158 0\n0 301 121 0\n0 0 1 0\n0 0 0 1\n", None, 500),
    "ScanNet, flat": ("intrinsic_color.txt", "300 0 158 0\n0 301 121 0\n0 0 1 0\n0 0 0 1\n", None, 500),
    "ETH3D": ("calibration.txt", "300 301 158 121\n", None, 500),
    "DROID-SLAM": ("calib.txt", "300.0 301.0 158.0 121.0 0.1 -0.2 0.001 -0.002 0.0", LENS, 500),
    "ORB-SLAM": ("calibration.yaml", ORB_SLAM, LENS, 2000),
    "ROS": ("camera_info.yaml", CAMERA_INFO, LENS, 500),
    "OpenCV": ("calibration.yml", OPENCV, LENS, 500),
    "Open3D": ("camera_intrinsic.json", json.dumps(OPEN3D), None, 500),
    "INI": ("camera.ini", "[color]\nfx = 300\nfy=301\ncx = 158\ncy = 121\n", None, 500),
    "BundleFusion": ("info.txt", INFO.format(color=CAMERA), None, 1000),
}


def written(folder: Path, file: str, content: str) -> Path:
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def seven_scenes(root: Path, size: tuple[int, int]) -> Path:
    for k in range(2):
        write_color(root / f"room/seq-01/frame-{k:06d}.color.jpg", (40 * k, 100, 200), size)
        write_depth(root / f"room/seq-01/frame-{k:06d}.depth.png", 2000, (240, 320))
        written(root / "room/seq-01", f"frame-{k:06d}.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    return root / "room/seq-01"


def tum(root: Path, size: tuple[int, int]) -> Path:
    folder = root / "my_freiburg1_room"
    for name, write, value in (("rgb", write_color, (9, 9, 9)), ("depth", write_depth, 2000)):
        for k in range(2):
            write(folder / f"{name}/{k}.png", value, size)
        written(folder, f"{name}.txt", "".join(f"{k}.0 {name}/{k}.png\n" for k in range(2)))
    return folder


def scenenn(root: Path, size: tuple[int, int]) -> Path:
    for k in range(1, 3):
        write_color(root / f"011/image/image{k:05d}.png", (9, 9, 9), size)
        write_depth(root / f"011/depth/depth{k:05d}.png", 2000, size)
    written(root, "intrinsic/asus.ini", "fx = 544\nfy = 544\ncx = 320\ncy = 240\n")
    return root / "011"


def replica(root: Path, size: tuple[int, int]) -> Path:
    for k in range(2):
        write_color(root / f"room0/results/frame{k:06d}.jpg", (9, 9, 9), size)
        write_depth(root / f"room0/results/depth{k:06d}.png", 2000, size)
    written(root, "room0/traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2)
    camera = {"w": 1200, "h": 680, "fx": 600, "fy": 600, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
    written(root, "cam_params.json", json.dumps({"camera": camera}))
    return root / "room0"


def icl(root: Path, size: tuple[int, int]) -> Path:
    for k in range(2):
        write_color(root / f"traj0_frei_png/rgb/{k}.png", (9, 9, 9), size)
        write_depth(root / f"traj0_frei_png/depth/{k}.png", 2000, size)
    written(root, "traj0_frei_png/traj0.gt.freiburg", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    return root / "traj0_frei_png"


LAYOUTS: dict[str, tuple[Callable[[Path, tuple[int, int]], Path], Callable[..., object]]] = {
    "seven_scenes": (seven_scenes, SevenScenes),
    "tum_rgbd": (tum, TumRgbd),
    "scenenn": (scenenn, SceneNN),
    "replica": (replica, ReplicaNiceSlam),
    "icl_nuim": (icl, IclNuim),
}


@pytest.mark.parametrize("program", FILES)
def test_own_camera_of_other_program_matches_file(
    tmp_path: Path, program: str, caplog: pytest.LogCaptureFixture
) -> None:
    file, content, lens, scale = FILES[program]
    write_color(tmp_path / "color/0.png", (1, 2, 3), (240, 320))
    path = written(tmp_path, file, content)
    with caplog.at_level("INFO"):
        own = own_camera("room", tmp_path, [tmp_path / "color/0.png"], 500)
    assert own is not None
    assert (own.stored.camera, own.stored.distortion, own.stored.depth_scale) == (CAMERA, lens, scale)
    assert f"room: camera from {path}, with {scale:g} depth units per m" in caplog.text


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("calibration.yaml", ORB_SLAM.replace("2000.0", "0.001")),
        ("info.txt", INFO.format(color=CAMERA).replace("Shift = 1000", "Shift = 0")),
    ],
)
def test_own_camera_implausible_depth_scale_raises(tmp_path: Path, file: str, content: str) -> None:
    folder = tum(tmp_path, (240, 320))
    path = written(folder, file, content)
    message = f"{path}: depth scale: expected 1 to 1e+06 units per m (1000 for millimeters), got 0"
    with pytest.raises(DataError, match=re.escape(message)):
        TumRgbd(folder.parent, scene=folder.name)
    corrected = TumRgbd(folder.parent, scene=folder.name, depth_reading=DepthReading(depth_scale=1000))
    assert corrected.calibration.depth_scale == 1000


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("program", ["InstanceMap", "ScanNet", "ETH3D", "ORB-SLAM", "BundleFusion"])
def test_own_camera_in_published_layout_is_used(
    tmp_path: Path, layout: str, program: str, caplog: pytest.LogCaptureFixture
) -> None:
    write, dataset = LAYOUTS[layout]
    folder = write(tmp_path, (240, 320))
    path = written(folder, FILES[program][0], FILES[program][1])
    with caplog.at_level("INFO"):
        sequence = dataset(folder.parent, scene=folder.name)
    assert sequence.camera == CAMERA
    assert f"camera from {path}" in caplog.text


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("camchain.calib.yaml", "cam0:\n  intrinsics: [300, 301, 158, 121]\n  distortion_model: equidistant\n"),
        ("cameras.txt", "# Camera list\n1 PINHOLE 320 240 300 301 158 121\n"),
        ("calibration.xml", "<camera><f>300</f></camera>"),
        ("intrinsics.txt", "300 158 301 121"),
        ("calib.txt", "320 240 300 301 158 121"),
        ("camera.yaml", ORB_SLAM.replace("PinHole", "KannalaBrandt8")),
    ],
)
def test_own_camera_in_unknown_format_raises(tmp_path: Path, layout: str, file: str, content: str) -> None:
    write, dataset = LAYOUTS[layout]
    folder = write(tmp_path, (240, 320))
    written(folder, file, content)
    with pytest.raises(DataError, match=rf"{file}: expected .*; write camera\.json, which takes precedence"):
        dataset(folder.parent, scene=folder.name)


@pytest.mark.parametrize("size", [(240, 320), (484, 648), (968, 1296)])
def test_seven_scenes_sensor_info_registers_color(tmp_path: Path, size: tuple[int, int]) -> None:
    """12-Scenes have a color camera of higher resolution than the depth camera."""
    folder = seven_scenes(tmp_path, size)
    color = Camera(size[1], size[0], 300 * size[1] / 320, 301 * size[0] / 240, size[1] / 2, size[0] / 2)
    written(folder, "info.txt", INFO.format(color=color))
    sequence = SevenScenes(tmp_path, scene="room/seq-01")
    assert sequence.camera == CAMERA
    frame = sequence[1]
    assert frame.color.shape == (240, 320, 3)
    assert np.abs(frame.color.astype(int) - (40, 100, 200)).max() < 4
    assert (frame.depth == 2).all()


@pytest.mark.parametrize("name", ["CameraTrajectory.txt", "camera_poses.txt", "info.md", "camera.png", "color.txt"])
def test_other_file_is_no_calibration(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    assert own_camera("room", tmp_path, [], 1000) is None
