"""Tests for jumps of stored poses."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.checking.changed_sequences import PosedSequence
from framework.checking.matched_pairs import Matcher
from framework.checking.pose_jumps import find_jumps
from framework.checking.recording_check import check, warn_of_poses
from framework.data import Float64
from framework.datasets.frames.conventions import PoseReading
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.rgbd_folder import RgbdFolder
from framework.datasets.tum_rgbd import TumRgbd
from framework.files.tum_trajectory import read_tum, write_tum
from framework.geometry import inverse
from plugins.trackers.trajectory_file import TrajectoryFile
from tests.support.recordings.damaged import write_damaged

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

ROS_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
DESK = TumRgbd(Path("data/desk"), scene="rgbd_dataset_freiburg1_rpy")


def motion(shift: tuple[float, ...], turn: tuple[float, ...] = (0, 0, 0)) -> Float64:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = shift, Rotation.from_rotvec(np.radians(turn)).as_matrix()
    return T


def jumping(T: Float64, after: Callable[[int], bool]) -> Callable[[Float64], Float64]:
    """Return a function that moves the poses of some frames, to be called in the order of the frames."""
    numbers = count()
    return lambda pose: T @ pose if after(next(numbers)) else pose


def jumps_of(recording: Recording) -> list[tuple[int, int]]:
    poses = [recording.contents.frames[index].T_world_camera for index in recording.chosen]
    found = find_jumps(Matcher(recording), poses, PoseReading(), revisits=0)
    return [(one.first, one.second) for one in found.neighbors]


@pytest.mark.parametrize(
    ("T", "after", "expected"),
    [
        (motion((0.3, 0, 0)), lambda k: k >= 9, [(8, 9)]),
        pytest.param(motion((0, 0, -0.3)), lambda k: k >= 5, [(4, 5)], marks=REPEATED),
        pytest.param(motion((0, 0, 0), (0, 0, 10)), lambda k: k >= 12, [(11, 12)], marks=REPEATED),
        (motion((0, 0, 0), (10, 0, 0)), lambda k: k == 7, [(6, 7), (7, 8)]),
        (motion((0.2, 0.1, 0)), lambda k: k == 0, [(0, 1)]),
        pytest.param(motion((0, 0.3, 0)), lambda k: k < 3, [(2, 3)], marks=REPEATED),
        (motion((0.15, 0, 0)), lambda k: k >= 17, [(16, 17)]),
        pytest.param(motion((0, 0, 0), (0, 6, 0)), lambda k: k in (5, 6), [(4, 5), (6, 7)], marks=REPEATED),
        (motion((2, 1, 0.5), (0, 0, 60)), lambda k: k % 6 >= 3, [(2, 3), (5, 6), (8, 9), (11, 12), (14, 15)]),
    ],
    ids=["sideways", "down", "turn", "single", "first", "start", "last", "pair", "two_worlds"],
)
def test_find_jumps_names_frames(
    tmp_path: Path, T: Float64, after: Callable[[int], bool], expected: list[tuple[int, int]]
) -> None:
    recording = RgbdFolder(write_damaged(tmp_path / "jump", DESK, pose=jumping(T, after), frames=18))
    assert jumps_of(recording) == expected


def test_find_jumps_next_to_blurred_frame_compares_next_frame(tmp_path: Path) -> None:
    """The frames 8 and 9 have no matches, so the jump between them is found between their neighbors."""
    place = write_damaged(tmp_path / "jump", DESK, pose=jumping(motion((0.3, 0, 0)), lambda k: k >= 9), frames=18)
    for k in (8, 9):
        [path] = place.glob(f"color/{k:06d}.*")
        color = cv2.imread(str(path))
        path.unlink()
        cv2.imwrite(str(path), cv2.GaussianBlur(color, (0, 0), 25))
    recording = RgbdFolder(place)
    assert jumps_of(recording) == [(7, 10)]


def test_find_jumps_in_valid_recordings_finds_none(shared_data: Path) -> None:
    assert not jumps_of(DESK)
    for name in ("mit76", "redwood5"):
        assert not jumps_of(RgbdFolder(shared_data / name))


def test_find_jumps_between_revisits_finds_drift(tmp_path: Path) -> None:
    """Each step is too small for a jump, but the camera sees the same place again at another pose."""
    numbers = count()

    def drifting(T: Float64) -> Float64:
        return motion((0.012 * next(numbers), 0, 0)) @ T

    recording = RgbdFolder(write_damaged(tmp_path / "drift", DESK, pose=drifting))
    poses = [recording.contents.frames[index].T_world_camera for index in recording.chosen]
    found = find_jumps(Matcher(recording), poses, PoseReading(), neighbors=30)
    assert not found.neighbors
    assert found.revisits
    finding = found.finding()
    assert finding is not None
    assert "frames of the same place" in finding.text


@pytest.mark.parametrize(
    ("stored", "late", "text"),
    [
        (lambda T: T, 0.0, ""),
        (inverse, 0.0, "stored as T_camera_world"),
        (lambda T: T @ ROS_AXES, 0.0, "x forward, y left, z up"),
        (lambda T: motion(tuple(999 * T[:3, 3])) @ T, 0.0, "translations are 1e+03 times as long"),
        (lambda T: T, 0.3, "inconsistent with the images"),
    ],
    ids=["valid", "inverse", "ros", "millimeters", "late"],
)
def test_warn_of_poses_of_trajectory_file_names_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, stored: Callable[[Float64], Float64], late: float, text: str
) -> None:
    times, poses = read_tum(DESK.folder / "groundtruth.txt")
    write_tum(tmp_path / "poses.txt", times + late, [stored(T) for T in poses])
    warn_of_poses(PosedSequence(DESK, TrajectoryFile(tmp_path / "poses.txt")), "check the poses")
    assert ("check the poses" in caplog.text) == bool(text)
    assert text in caplog.text


@pytest.mark.acceptance
def test_check_of_two_world_frames_reports_jumps_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The poses alternate between two world frames, which looks like a wrong scale to the median pair."""
    mixed = jumping(motion((1, 2, 0.5), (0, 0, 40)), lambda k: k % 20 >= 10)
    recording = RgbdFolder(write_damaged(tmp_path / "mixed", DESK, pose=mixed))
    [error] = check(recording, 5.0).errors
    assert error.text.startswith("jump between the neighboring frames 9 and 10 (by ")
    assert error.setting == "tracker=voxel_hashing_icp"
    warn_of_poses(recording)
    assert "jump between the neighboring frames 9 and 10" in caplog.text
