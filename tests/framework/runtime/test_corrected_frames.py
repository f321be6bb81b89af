"""Tests for the corrected poses of tracked frames."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from framework.data import Pose
from framework.interfaces import SubmapChange
from framework.runtime.corrected_frames import CorrectedFrames, TrackedFrame
from framework.runtime.spooled_list import CHUNK, Spool

FRAMES = CHUNK + 5


def translation(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.fixture
def frames() -> CorrectedFrames:
    """Return frames at x = 0, in the submaps 0, 1 and 1 again, which are moved to x = 5, 4 and 3."""
    frames = CorrectedFrames(Spool())
    changes = {
        3: SubmapChange(submap=1),
        CHUNK: SubmapChange({1: translation(1)}, submap=1),
        FRAMES - 1: SubmapChange({0: translation(5), 1: translation(3)}, submap=2),
    }
    for k in range(FRAMES):
        frames.append(TrackedFrame(k, k, k / 30, Pose(np.eye(4), covariance=k * np.eye(6)), None))
        if k in changes:
            frames.correct(changes[k])
    return frames


def positions(frames: list[TrackedFrame]) -> list[float]:
    return [float(frame.pose.T_world_camera[0, 3]) for frame in frames]


def test_corrected_frames_move_with_their_submap(frames: CorrectedFrames) -> None:
    expected = [5.0] * 4 + [4.0] * (CHUNK - 3) + [3.0] * 4
    assert positions(list(frames)) == positions(frames[:]) == expected
    assert positions([frames[k] for k in range(-FRAMES, FRAMES)]) == 2 * expected
    assert positions(list(frames.as_tracked)) == [0.0] * FRAMES
    assert positions(list(pickle.loads(pickle.dumps(frames)))) == expected
    assert [frame.index for frame in frames] == list(range(FRAMES))
    np.testing.assert_array_equal(frames[7].pose.covariance, 7 * np.eye(6))
    assert frames.submap == 2


def test_correction_returns_largest_motion(frames: CorrectedFrames) -> None:
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z, by half a turn: moves the last frames from x = 3 to -3
    assert frames.correct(SubmapChange({1: turned, 0: translation(-2)}, submap=2)) == 8  # from x = 4 to -4
    assert frames.correct(SubmapChange({2: translation(9)}, submap=2)) == 0  # no frame
    assert frames.correct(SubmapChange(submap=3)) == 0


def test_cleared_frames_keep_current_submap(frames: CorrectedFrames) -> None:
    frames.clear()
    assert (len(frames), list(frames), frames.submap) == (0, [], 2)
    frames.append(TrackedFrame(0, 0, 0.0, Pose(np.eye(4)), None))
    frames.correct(SubmapChange({2: translation(2)}, submap=2))
    assert positions(list(frames)) == [2.0]
