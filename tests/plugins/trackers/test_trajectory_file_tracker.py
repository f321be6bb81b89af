"""Tests for poses from a trajectory file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.errors import ConfigError, DataError, NoPoseError
from framework.files.tum_trajectory import write_tum
from framework.geometry import exp_se3
from plugins.trackers.trajectory_file import TrajectoryFile, World
from tests.support import registered
from tests.support.recordings.trajectory_files import write_euroc, write_kitti, write_tum_with_ids
from tests.support.scenes.corner_room import CornerRoom, GridMap, pose_at

SCENE = GridMap()
T_FILE_WORLD = exp_se3(np.array([3.0, -2.0, 1.0, 0.4, -0.7, 0.2]))  # world frame of another system


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Write the poses of frames 0 to 5 of the corner room except frame 3. The timestamps are 4 ms late."""
    path = tmp_path / "other_slam.txt"
    frames = [0, 1, 2, 4, 5]
    write_tum(path, [k / 30 + 0.004 for k in frames], [T_FILE_WORLD @ pose_at(k) for k in frames])
    return path


def test_trajectory_file_poses_are_aligned_to_first_frame(path: Path) -> None:
    tracker = TrajectoryFile(path)
    for k, frame in enumerate(CornerRoom()):
        if k != 3:
            np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, pose_at(k), atol=1e-9)


def test_trajectory_file_frame_without_pose_raises_with_reason(path: Path) -> None:
    tracker = TrajectoryFile(path)
    with pytest.raises(NoPoseError) as caught:
        tracker.track(CornerRoom()[3], SCENE)
    why = (
        "frame 3: other_slam.txt: expected a pose within 0.02 s (tracker.max_time_difference) of 0.100 s, "
        "got the nearest pose 0.029 s away"
    )
    assert str(caught.value) == why


def test_trajectory_file_first_pose_without_truth_is_identity(path: Path) -> None:
    tracker = TrajectoryFile(path)
    first, second = (tracker.track(frame, SCENE) for frame in CornerRoom(frames=2, truth=False))
    np.testing.assert_allclose(first.T_world_camera, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(second.T_world_camera, np.linalg.inv(pose_at(0)) @ pose_at(1), atol=1e-9)


def test_trajectory_file_in_world_frame_keeps_coordinates(path: Path) -> None:
    tracker = TrajectoryFile(path, world_frame=World.FILE)
    for k, frame in enumerate(CornerRoom(frames=3)):
        np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, T_FILE_WORLD @ pose_at(k), atol=1e-9)


def test_trajectory_file_late_start_sets_world_at_first_pose(tmp_path: Path) -> None:
    path = tmp_path / "late.txt"
    write_tum(path, [2 / 30, 3 / 30], [T_FILE_WORLD @ pose_at(k) for k in (2, 3)])
    tracker = TrajectoryFile(path)
    for k, frame in enumerate(CornerRoom(frames=4)):
        if k < 2:
            with pytest.raises(NoPoseError):
                tracker.track(frame, SCENE)
        else:
            np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, pose_at(k), atol=1e-9)


def test_trajectory_file_time_offset_aligns_clocks(tmp_path: Path) -> None:
    path = tmp_path / "clock.txt"
    write_tum(path, [1.7e9, 1.7e9 + 1 / 30], [pose_at(0), pose_at(1)])
    frames = [replace(frame, timestamp=frame.timestamp + 12) for frame in CornerRoom(frames=2)]
    with pytest.raises(NoPoseError, match="got the nearest"):
        TrajectoryFile(path).track(frames[0], SCENE)
    tracker = TrajectoryFile(path, time_offset=12 - 1.7e9)
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, pose_at(k), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0 nan 0 0 0 1\n", "line 1: expected a finite pose, got"),
        ("0 0 0 0 0 0 0 2\n", "line 1: expected a quaternion .* of length 1, got 2"),
        ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "line 2: expected a timestamp > 1 s, got 0 s"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: expected a timestamp > 1 s, got 1 s"),
        ("1 0 0 0\n", "line 1: expected 8 numbers"),
        ("# nothing\n", "expected poses, got none"),
    ],
)
def test_trajectory_file_invalid_raises_one_line_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(DataError, match=rf"bad\.txt.* {message}") as refused:
        registered.built("tracker", "trajectory_file", f"tracker.path={tmp_path / 'bad.txt'}")
    assert "\n" not in str(refused.value)


def test_trajectory_file_missing_or_invalid_parameter_raises(tmp_path: Path, path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.txt: expected a trajectory in TUM format, got no such file"):
        TrajectoryFile(tmp_path / "nowhere.txt")
    with pytest.raises(ConfigError, match=r"TrajectoryFile\.max_time_difference"):
        TrajectoryFile(path, max_time_difference=-1)
    with pytest.raises(ConfigError, match=r"tracker\.path"):
        registered.built("tracker", "trajectory_file")


@pytest.mark.parametrize(
    ("unit", "start"), [(1e-9, 1305031100.0), (1e-9, 3.0), (1e-6, 1305031100.0), (1e-3, 1305031100.0), (1e-3, 20.0)]
)
def test_trajectory_file_in_other_time_unit_names_setting(tmp_path: Path, unit: float, start: float) -> None:
    path = tmp_path / "other.txt"
    write_tum(path, [(start + k / 30) / unit for k in range(3)], [pose_at(k) for k in range(3)])
    frames = [replace(frame, timestamp=start + frame.timestamp) for frame in CornerRoom(frames=3)]
    with pytest.raises(NoPoseError, match=rf"set tracker\.time_unit={unit:g} \(the timestamps are in \w+seconds\)"):
        TrajectoryFile(path).track(frames[0], SCENE)
    tracker = TrajectoryFile(path, time_unit=unit)
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, pose_at(k), atol=1e-9)


@pytest.mark.parametrize(("stored", "frames"), [(0.0, 1305031100.0), (1305031100.0, 0.0), (86400.0, 5.5)])
def test_trajectory_file_of_other_clock_names_offset(tmp_path: Path, stored: float, frames: float) -> None:
    path = tmp_path / "other.txt"
    write_tum(path, [stored + k / 30 for k in range(3)], [pose_at(k) for k in range(3)])
    first = replace(CornerRoom(frames=1)[0], timestamp=frames)
    with pytest.raises(NoPoseError) as caught:
        TrajectoryFile(path).track(first, SCENE)
    offset = float(re.findall(r"set tracker\.time_offset=(\S+)", str(caught.value))[0])
    TrajectoryFile(path, time_offset=offset).track(first, SCENE)


def test_trajectory_file_kitti_line_belongs_to_frame_index(tmp_path: Path) -> None:
    write_kitti(tmp_path / "poses.txt", [], [T_FILE_WORLD @ pose_at(k) for k in range(4)])
    tracker = TrajectoryFile(tmp_path / "poses.txt")
    frames = list(CornerRoom(frames=5))
    for k in (1, 3):  # with dataset.start=1 dataset.stride=2
        np.testing.assert_allclose(tracker.track(frames[k], SCENE).T_world_camera, pose_at(k), atol=1e-5)
    with pytest.raises(NoPoseError, match=r"frame 4: poses.txt: expected a line for each frame, got 4 lines"):
        tracker.track(frames[4], SCENE)


@pytest.mark.parametrize("write", [write_euroc, write_tum_with_ids])
def test_trajectory_file_other_formats_match_timestamps(tmp_path: Path, write: Callable[..., None]) -> None:
    frames = [replace(frame, timestamp=frame.timestamp + 1.7e9) for frame in CornerRoom(frames=3)]
    write(tmp_path / "poses.csv", [frame.timestamp for frame in frames], [pose_at(k) for k in range(3)])
    tracker = TrajectoryFile(tmp_path / "poses.csv", world_frame=World.FILE)
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(tracker.track(frame, SCENE).T_world_camera, pose_at(k), atol=1e-8)
