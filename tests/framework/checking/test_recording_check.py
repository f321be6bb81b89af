"""Tests for the check of recordings. Each wrong convention must be reported with the setting that corrects it."""

from __future__ import annotations

import logging
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.checking import Finding, Verdict
from framework.checking.recording_check import check, warn_of_poses
from framework.data import Float64, Frame
from framework.datasets.frames.conventions import CameraAxes, DepthReading, PoseKind, PoseReading, QuaternionOrder
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import DataError, FrameError
from framework.geometry import inverse
from framework.interfaces import RGBDSequence
from tests.support.recordings.damaged import in_millimeters, inverted_opengl, scalar_first, write_damaged

pytestmark = pytest.mark.integration

FARTHEST = 5.0  # maximum mapped depth, m
FRAMES = 34  # half of the desk, which halves the time of a check
DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy", stop=FRAMES)


KIND, AXES, DELAY, POSES = (f"dataset.{name}=" for name in ("pose_kind", "camera_axes", "depth_delay", "pose_delay"))


def settings(findings: tuple[Finding, ...]) -> list[str]:
    return [finding.setting for finding in findings if finding.verdict is Verdict.ERROR]


@pytest.mark.parametrize(
    ("damage", "setting"),
    [
        ({"pose": scalar_first}, "dataset.quaternion_order=WXYZ"),
        ({"pose": in_millimeters}, "dataset.pose_unit=0.001"),
        ({"poses_late": 3, "pose": inverted_opengl}, f"{POSES}3 {KIND}T_CAMERA_WORLD {AXES}OPENGL"),
        ({"poses_late": -3, "depth_late": -3}, f"{POSES}-3 {DELAY}-3"),
    ],
)
def test_recording_check_of_changed_desk_names_setting(tmp_path: Path, damage: Mapping[str, Any], setting: str) -> None:
    place = write_damaged(tmp_path / "damaged", DESK, frames=FRAMES, **damage)
    assert " ".join(settings(check(RgbdFolder(place), FARTHEST).findings)) == setting


def test_recording_check_applies_configured_conventions(tmp_path: Path) -> None:
    """With the correct parameters, the damaged recording has no errors. Other values are reported."""
    place = write_damaged(tmp_path / "damaged", DESK, pose=inverted_opengl, scale=2.0, depth_late=1, poses_late=-2)
    reading = PoseReading(PoseKind.T_CAMERA_WORLD, CameraAxes.OPENGL, pose_delay=-2)
    depth = DepthReading(depth_scale=5000, depth_delay=1)
    assert not check(RgbdFolder(place, pose_reading=reading, depth_reading=depth), FARTHEST).errors
    wrong = replace(reading, quaternion_order=QuaternionOrder.WXYZ, pose_delay=1)
    found = check(RgbdFolder(place, pose_reading=wrong, depth_reading=replace(depth, depth_delay=3)), FARTHEST)
    assert settings(found.findings) == [POSES + "-2", "dataset.quaternion_order=XYZW", DELAY + "1"]
    assert "3 frames early (0.0" in found.errors[0].text


def test_recording_check_reports_clock_delay_in_two_units(tmp_path: Path) -> None:
    """The pose timestamps of the desk in TUM format are 0.1 s late. The delay is reported in frames and in seconds."""
    shutil.copytree(DESK.folder, tmp_path / DESK.name)
    path = tmp_path / DESK.name / "groundtruth.txt"
    words = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("".join(f"{float(time) + 0.1:.4f} {' '.join(pose)}\n" for time, *pose in words))
    [fault] = check(TumRgbd(tmp_path, scene=DESK.name, stop=FRAMES), FARTHEST).errors
    assert fault.setting == POSES + "3"
    assert "3 frames late (0.096 s)" in fault.text


def test_recording_check_unrelated_poses_fit_no_convention(tmp_path: Path) -> None:
    turned = iter(range(1000))

    def another(_: Float64) -> Float64:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec((0, 0, 0.5 * next(turned))).as_matrix()
        return T

    [fault] = check(RgbdFolder(write_damaged(tmp_path / "damaged", DESK, frames=FRAMES, pose=another)), FARTHEST).errors
    assert fault.subject == "poses"
    assert "in all supported conventions" in fault.text
    assert "tracker=voxel_hashing_icp" in fault.setting


@dataclass
class MovedDepth(RGBDSequence):
    """The desk with depth images warped by an affine matrix (2, 3), px, like images of a separate depth camera."""

    moved: Float64

    def __post_init__(self) -> None:
        self.camera, self.name = DESK.camera, "moved"

    def __len__(self) -> int:
        return len(DESK)

    def __getitem__(self, k: int) -> Frame:
        frame = DESK[k]
        size = frame.depth.shape[::-1]
        return replace(frame, depth=cv2.warpAffine(frame.depth, self.moved, size, flags=cv2.INTER_NEAREST))


@pytest.mark.parametrize(("zoom", "x", "y"), [(1.0, -20, 8), (1.11, 0, 0)])
def test_recording_check_reports_unregistered_depth(zoom: float, x: float, y: float) -> None:
    moved = cv2.getRotationMatrix2D((319.5, 239.5), 0, zoom)
    moved[:, 2] += (x, y)
    [fault] = [fault for fault in check(MovedDepth(moved), FARTHEST).errors if fault.subject == "color and depth"]
    assert "not registered" in fault.text
    if zoom == 1:
        found_x, found_y = (float(number) for number in re.findall(r"([+-][0-9.]+)%", fault.text))
        # % of the image width; the reported shift corrects the offset
        assert found_x == pytest.approx(-100 * x / 640, abs=0.4)
        assert found_y == pytest.approx(-100 * y / 640, abs=0.4)


def test_recording_check_half_frame_color_delay_gives_note() -> None:
    """The image moves by 20 px per frame at the beginning, and a Kinect captures color and depth separately."""
    [note] = [
        finding for finding in check(replace(DESK, stop=6), FARTHEST).findings if finding.subject == "color and depth"
    ]
    assert note.verdict is Verdict.NOTE
    assert "with an image motion of" in note.text


@dataclass
class Part(RGBDSequence):
    """The first `count` frames of the desk, without poses and changed by `change`."""

    count: int
    change: Callable[[Frame], Frame] = lambda frame: frame

    def __post_init__(self) -> None:
        self.camera, self.name = DESK.camera, "part"

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, k: int) -> Frame:
        return self.change(replace(DESK[k], T_world_camera=None))

    def has_poses(self) -> bool:
        return False


def verdicts(sequence: RGBDSequence) -> dict[str, Verdict]:
    return {finding.subject: finding.verdict for finding in check(sequence, FARTHEST).findings}


def test_recording_check_accepts_single_frame_or_missing_poses() -> None:
    fine = dict.fromkeys(("depth", "poses", "sharpness", "sensor", "color delay"), Verdict.FINE)
    assert verdicts(Part(1)) == fine | dict.fromkeys(("motion", "color and depth"), Verdict.UNKNOWN)
    assert verdicts(Part(20)) == fine | dict.fromkeys(("motion", "color and depth"), Verdict.FINE)


def test_recording_check_reports_defective_images() -> None:
    def blurred(frame: Frame) -> Frame:
        return replace(frame, color=cv2.GaussianBlur(frame.color, (0, 0), 12))

    def gray(frame: Frame) -> Frame:
        return replace(frame, color=np.full_like(frame.color, 128))

    def nothing(frame: Frame) -> Frame:
        return replace(frame, depth=np.zeros_like(frame.depth))

    def sparse(frame: Frame) -> Frame:
        depth = frame.depth.copy()
        depth[::2] = depth[:, ::2] = 0
        return replace(frame, depth=depth)

    assert verdicts(Part(8, blurred))["sharpness"] is Verdict.NOTE
    assert verdicts(Part(8, gray))["motion"] is Verdict.NOTE
    assert verdicts(Part(8, gray))["color and depth"] is Verdict.UNKNOWN
    assert verdicts(Part(8, nothing))["depth"] is Verdict.ERROR
    assert verdicts(Part(8, sparse))["depth"] is Verdict.NOTE


def test_recording_check_reports_unreadable_frames() -> None:
    def unreadable(frame: Frame) -> Frame:
        if frame.index % 3 == 0:
            raise FrameError("truncated image")
        return frame

    def none(_: Frame) -> Frame:
        raise FrameError("truncated image")

    assert verdicts(Part(30, unreadable))["frames"] is Verdict.NOTE
    with pytest.raises(
        DataError, match=r"expected at least one readable frame, got none among 8 .*; first error: truncated image"
    ):
        check(Part(8, none), FARTHEST)


def test_run_with_inverted_poses_logs_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    warn_of_poses(DESK)
    warn_of_poses(Part(20))
    assert not caplog.text
    warn_of_poses(RgbdFolder(write_damaged(tmp_path / "damaged", DESK, frames=FRAMES, pose=inverse)))
    assert "poses: stored as T_camera_world" in caplog.text
    assert "run `instancemap check`" in caplog.text


def test_check_reports_depth_sensor() -> None:
    [finding] = [finding for finding in check(replace(DESK, stop=6), FARTHEST).findings if finding.subject == "sensor"]
    assert (finding.verdict, finding.setting) == (Verdict.FINE, "")
    assert finding.text == "KINECT_V1, standard deviation of depth 1.9 mm at 1 m, 14.0 mm at 3 m"
