"""Tests for the journal of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Camera, Frame, Pose
from framework.runtime.digests import digest_of
from framework.runtime.run_log import Journal, StageTime
from framework.runtime.spooled_list import CHUNK
from tests.support.scenes.corner_room import GridFuser

FRAMES = 2 * CHUNK + 3


def frame_at(index: int) -> Frame:
    camera = Camera(2, 2, 1.0, 1.0, 0.5, 0.5)
    return Frame(index, index / 30, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32), camera, np.eye(4))


def test_journal_of_long_run_returns_data_of_all_frames(tmp_path: Path) -> None:
    """The tracker returns poses of its own class, which cannot be pickled."""

    @dataclass(frozen=True)
    class OwnPose(Pose):
        residuals: object = lambda: 0

    poses = []
    with Journal(GridFuser().scene, FRAMES, "tracked", tmp_path) as journal:
        for k in range(FRAMES):
            T_world_camera = np.eye(4)
            T_world_camera[0, 3] = k
            poses.append(OwnPose(T_world_camera, lost=k == 5, reason="blur" * (k == 5), covariance=np.eye(6) * k))
            journal.frame_begins()
            journal.record([StageTime(k, "reading", k / 7)])
            journal.frame_tracked(frame_at(k), poses[k])
            assert journal.stage_ms(k) == {"reading": k / 7}
    result = journal.result()
    assert [(one.index, one.position, one.timestamp) for one in result.tracked] == [
        (k, k, k / 30) for k in range(FRAMES)
    ]
    for one, pose in zip(result.tracked, poses, strict=True):
        np.testing.assert_array_equal(one.pose.T_world_camera, pose.T_world_camera)
        np.testing.assert_array_equal(one.pose.covariance, pose.covariance)
        np.testing.assert_array_equal(one.T_world_camera_truth, np.eye(4))
        assert (one.pose.lost, one.pose.reason) == (pose.lost, pose.reason)
    assert list(result.timings) == [StageTime(k, "reading", k / 7) for k in range(FRAMES)]
    assert [(one.frame, one.stage, one.digest) for one in result.digests] == [
        (k, "tracking", digest_of(pose)) for k, pose in enumerate(poses)
    ]
    assert len(result.intervals) == FRAMES - 1
    assert result.frames_lost == 1
    assert not list(tmp_path.iterdir())


def test_journal_that_forgets_frames_keeps_stage_times() -> None:
    journal = Journal(GridFuser().scene, 0, "tracked")
    for k in range(3):
        journal.forget_frames()
        journal.record([StageTime(k, "detection", 1.0), StageTime(k, "tracking", 2.0)])
        journal.digest(k, tracking=Pose(np.eye(4)))
        assert journal.stage_ms(k) == {"detection": 1.0, "tracking": 2.0}
        assert journal.stage_ms(k - 1) == {}
    assert (len(journal.timings), len(journal.digests)) == (2, 1)
