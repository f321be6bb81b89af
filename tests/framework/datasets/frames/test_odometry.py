"""Tests of the odometry of a sequence, read from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.config.composition import composed
from framework.data import Float64
from framework.datasets.frames.odometry import Odometry, OdometryFile
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import DataError
from framework.files.tum_trajectory import write_tum
from framework.geometry import exp_se3, inverse
from framework.interfaces import RGBDVideo
from framework.registry import build
from framework.runs.inputs import input_hashes

TWIST = np.array([0.3, -0.1, 0.2, 0.0, 0.4, 0.1])  # velocity, m/s and rad/s
DESK: dict[str, Any] = {"root": Path("data/desk"), "scene": "rgbd_dataset_freiburg1_rpy"}
R_base_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x forward, y left, z up
BASE_AXES = "-0.5 0.5 -0.5 0.5"  # quaternion of R_base_camera


def turning(timestamp: float) -> Float64:
    """Return T_odom_base of a base that turns at a constant rate while it moves straight."""
    T = exp_se3(np.r_[0, 0, 0, TWIST[3:] * timestamp])
    T[:3, 3] = TWIST[:3] * timestamp
    return T


def written(folder: Path, timestamps: Float64) -> Path:
    path = folder / "odometry.txt"
    write_tum(path, timestamps, [turning(t) for t in timestamps])
    return path


def test_odometry_is_interpolated_exactly_for_constant_velocity(tmp_path: Path) -> None:
    odometry = OdometryFile(written(tmp_path, np.arange(0, 1, 0.1))).read()
    assert odometry is not None
    for t in (0.0, 0.1, 0.234, 0.9):
        T_odom_camera = odometry.at(t)
        assert T_odom_camera is not None
        np.testing.assert_allclose(T_odom_camera, turning(t), atol=1e-9)


def test_odometry_is_unknown_outside_and_in_gaps() -> None:
    timestamps = np.array([0.0, 0.5, 1.1, 1.2])
    odometry = Odometry(timestamps, np.array([turning(t) for t in timestamps]), np.eye(4))
    expected = {-0.01: False, 0.0: True, 0.3: True, 0.5: False, 0.8: False, 1.1: True, 1.2: True, 1.21: False}
    assert odometry.covers(np.array([*expected])).tolist() == [*expected.values()]
    assert {t: odometry.at(t) is not None for t in expected} == expected


def test_odometry_of_base_is_converted_to_camera(tmp_path: Path) -> None:
    """The camera is 0.2 m in front of and 0.5 m above the base, and looks forward."""
    path = written(tmp_path, np.arange(0, 1, 0.1))
    odometry = OdometryFile(path, f"0.2 0 0.5 {BASE_AXES}").read()
    assert odometry is not None
    T_odom_camera = odometry.at(0.45)
    assert T_odom_camera is not None
    T_base_camera = inverse(turning(0.45)) @ T_odom_camera
    np.testing.assert_allclose(T_base_camera[:3, :3], R_base_camera, atol=1e-9)
    np.testing.assert_allclose(T_base_camera[:3, 3], [0.2, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("stride", [1, 7])
def test_odometry_of_frames_is_at_depth_timestamps(stride: int, tmp_path: Path) -> None:
    times = np.array([frame.depth_time for frame in (TumRgbd(**DESK)[0], TumRgbd(**DESK, start=60)[0])])
    start = times[0] - 1
    path = tmp_path / "odometry.txt"
    stored = np.arange(start, times[1] + 2, 0.01)
    write_tum(path, stored, [turning(t - start) for t in stored])
    sequence = TumRgbd(**DESK, stop=60, stride=stride, odometry_file=OdometryFile(path))
    for k in (0, len(sequence) - 1):
        frame = sequence[k]
        assert frame.depth_time != frame.color_time
        assert frame.T_odom_camera is not None
        np.testing.assert_allclose(frame.T_odom_camera, turning(frame.depth_time - start), atol=1e-6)


def test_odometry_of_uncovered_frames_is_none_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = TumRgbd(**DESK)[0].depth_time
    path = tmp_path / "odometry.txt"
    stored = [first - 0.01, first + 0.01]
    write_tum(path, stored, [turning(0), turning(0.02)])
    sequence = TumRgbd(**DESK, stop=10, odometry_file=OdometryFile(path))
    assert sequence[0].T_odom_camera is not None
    assert sequence[1].T_odom_camera is None
    assert "9 of 10 frames have no odometry" in caplog.text


def test_odometry_without_any_frame_raises(tmp_path: Path) -> None:
    expected = r"dataset\.odometry: expected poses at the times of the frames \(1305031233\.\d+ to .* s\), got poses"
    with pytest.raises(DataError, match=expected):
        TumRgbd(**DESK, odometry_file=OdometryFile(written(tmp_path, np.arange(3.0))))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0 0 0 0 0 0 0 1\n", "expected at least 2 poses in TUM format, got 1"),
        ("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", r"line 2: expected a timestamp > 0 s, got 0 s"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 2\n", r"line 2: expected a quaternion qx qy qz qw of length 1, got 2"),
    ],
)
def test_odometry_invalid_file_raises(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "odometry.txt"
    path.write_text(content)
    with pytest.raises(DataError, match=rf"odometry\.txt.*{message}"):
        OdometryFile(path).read()


def test_odometry_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"dataset\.odometry: expected an existing file in TUM format, got .*none"):
        OdometryFile(tmp_path / "none.txt").read()


@pytest.mark.parametrize(
    ("camera", "message"),
    [("0 0 0", r"expected 7 numbers \(tx ty tz qx qy qz qw\), got 3"), ("0 0 0 0 0 0 2", "of length 1, got 2")],
)
def test_odometry_invalid_camera_raises(camera: str, message: str) -> None:
    with pytest.raises(DataError, match=rf"dataset\.odometry_camera: .*{message}"):
        OdometryFile(None, camera)


def test_odometry_keys_of_config_are_used_and_hashed(tmp_path: Path) -> None:
    first = TumRgbd(**DESK)[0].depth_time
    path = tmp_path / "odometry.txt"
    write_tum(path, [first - 0.2, first + 0.2], [turning(0), turning(0.4)])
    keys = (f"dataset.odometry={path}", f"dataset.odometry_camera=0.2 0 0.5 {BASE_AXES}", "dataset.stop=1")
    config = composed("dataset=desk", *keys)
    T_odom_camera = build(RGBDVideo, config.dataset)[0].T_odom_camera  # type: ignore[index]
    np.testing.assert_allclose(T_odom_camera[:3, :3], turning(0.2)[:3, :3] @ R_base_camera, atol=1e-6)
    before = input_hashes({"dataset": {"odometry": str(path)}})
    assert before.keys() == {"dataset.odometry"}
    path.write_text(path.read_text() + "# changed\n")
    assert input_hashes({"dataset": {"odometry": str(path)}}) != before
