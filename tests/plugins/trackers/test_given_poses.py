"""Tests for trackers with given poses.

Frames without a pose are skipped, counted and logged in one line.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.data import Frame
from framework.errors import DataError
from framework.files.tum_trajectory import write_tum
from framework.interfaces import PoseTracker
from framework.pipeline import Pipeline
from framework.runs.metrics import run_metrics, trajectory_metrics
from plugins.detectors.none import NoDetections
from plugins.trackers.ground_truth import GroundTruth
from plugins.trackers.trajectory_file import TrajectoryFile
from tests.support.scenes.corner_room import CornerRoom, GridFuser, KeepAll, pose_at

GAP = (0, 3, 4)
FRAMES = 9
POSED = [k for k in range(FRAMES) if k not in GAP]


def pipeline(tracker: PoseTracker, fuser: GridFuser | None = None) -> Pipeline:
    return Pipeline(NoDetections(), tracker, KeepAll(), fuser or GridFuser(), prefetch=0)


def true_poses(_: Path) -> PoseTracker:
    return GroundTruth()


def poses_from_file(folder: Path) -> PoseTracker:
    write_tum(folder / "poses.txt", [k / 30 for k in POSED], [pose_at(k) for k in POSED])
    return TrajectoryFile(folder / "poses.txt")


TRACKERS = pytest.mark.parametrize(
    ("tracker", "first"),
    [
        (true_poses, "frame 0: expected a ground-truth pose at 0.000 s, got none"),
        (
            poses_from_file,
            "frame 0: poses.txt: expected a pose within 0.02 s (tracker.max_time_difference) of 0.000 s, "
            "got the nearest pose 0.033 s away",
        ),
    ],
)


@TRACKERS
def test_given_poses_skip_frames_without_pose_with_one_warning(
    tmp_path: Path, tracker: Callable[[Path], PoseTracker], first: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("WARNING")
    fuser = GridFuser()
    result = pipeline(tracker(tmp_path), fuser).run(CornerRoom(frames=FRAMES, unposed=GAP))
    metrics = run_metrics(result)
    assert (metrics["frames"], metrics["frames_skipped"], metrics["frames_lost"]) == (FRAMES, len(GAP), 0)
    assert [frame.index for frame in result.tracked] == POSED
    for frame in result.tracked:
        np.testing.assert_allclose(frame.pose.T_world_camera, pose_at(frame.index), atol=1e-9)
    assert len(fuser.scene.vertices) == len(POSED)
    assert [record.message for record in caplog.records] == [
        f"3 of 9 frames skipped because they have no pose; the first: {first}"
    ]


@TRACKERS
def test_given_poses_unreadable_frame_is_logged_separately(
    tmp_path: Path, tracker: Callable[[Path], PoseTracker], first: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Unreadable frames are logged one by one, up to a limit. Frames without a pose do not count toward the limit."""
    caplog.set_level("WARNING")
    late = 30
    room = CornerRoom(frames=late + 2, unposed=tuple(range(late)), unreadable=late)
    given = tracker(tmp_path)
    if isinstance(given, TrajectoryFile):
        write_tum(given.path, [(late + 1) / 30], [pose_at(late + 1)])
        given = TrajectoryFile(given.path)
    assert pipeline(given).run(room).frames_skipped == late + 1
    assert [record.message for record in caplog.records] == [
        f"frame skipped: frame {late}: depth/{late:06d}.png is truncated",
        *(record.message for record in caplog.records if record.message.startswith(f"{late} of {late + 2} frames")),
    ]
    assert len(caplog.records) == 2


def test_given_poses_error_uses_only_frames_with_true_pose(tmp_path: Path) -> None:
    """In frames without a true pose, the given poses are wrong, which must not affect the errors."""
    poses = [np.linalg.inv(pose_at(9 * k)) if k in GAP else pose_at(k) for k in range(FRAMES)]
    write_tum(tmp_path / "poses.txt", [k / 30 for k in range(FRAMES)], poses)
    tracker = TrajectoryFile(tmp_path / "poses.txt")
    result = pipeline(tracker).run(CornerRoom(frames=FRAMES, unposed=(3, 4)))
    assert result.frames_skipped == 0
    errors = trajectory_metrics(result)
    assert errors["trajectory.ate_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert errors["trajectory.rpe_rmse_m"] == pytest.approx(0, abs=1e-9)


@TRACKERS
def test_given_poses_missing_in_all_frames_raise_one_line_error(
    tmp_path: Path, tracker: Callable[[Path], PoseTracker], first: str, caplog: pytest.LogCaptureFixture
) -> None:
    room = CornerRoom(frames=1, unposed=GAP)
    with pytest.raises(DataError) as caught:
        pipeline(tracker(tmp_path)).run(room)
    assert str(caught.value) == (
        f"corner_room: expected poses, got none for the 1 frames (first: {first}); "
        "add the poses of the sequence, or estimate them with tracker=voxel_hashing_icp"
    )
    assert not caplog.records


def test_given_poses_missing_in_sequence_raise_before_reading() -> None:
    class Unposed(CornerRoom):
        def has_poses(self) -> bool:
            return False

        def __getitem__(self, k: int) -> Frame:
            raise AssertionError("a frame was read")

    with pytest.raises(
        DataError, match="corner_room: expected ground-truth poses, got none for the 6 frames; add the poses"
    ):
        pipeline(GroundTruth()).run(Unposed())
