"""Tests for the drawn camera path, which must equal the corrected trajectory of a run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Detections, Frame, Pose
from framework.interfaces import SubmapChange, SubmapGraph, Viewer
from framework.live_view.drawn_path import PIECE, DrawnPath
from framework.pipeline import Pipeline
from tests.support.scenes.corner_room import CornerRoom, KeepAll, SphereDetector
from tests.support.scenes.given_changes import GivenChanges, RoomTracker, SubmapFuser

UP = np.array([0.0, 0.0, 1.0])


class DrawsPath(Viewer):
    def __init__(self) -> None:
        self.path = DrawnPath()

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        self.path.add(frame.index, pose.T_world_camera[:3, 3])

    def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
        self.path.correct(change)


def moved(submap: int, meters: float) -> SubmapChange:
    """Return a motion upward of one submap, after which submap 1 begins."""
    T_new_old = np.eye(4)
    T_new_old[2, 3] = meters
    return SubmapChange({submap: T_new_old}, submap=1)


def lines(path: DrawnPath) -> dict[int, list[float]]:
    """Return the heights along each changed piece by its number."""
    return {k: line[:, 2].tolist() for k, line in path.changed()}


def test_drawn_path_equals_corrected_trajectory(room: CornerRoom) -> None:
    viewer = DrawsPath()
    result = Pipeline(
        SphereDetector(), RoomTracker(), KeepAll(), SubmapFuser(), viewer=viewer, backend=GivenChanges()
    ).run(room)
    for one in result.tracked:
        np.testing.assert_allclose(viewer.path.position(one.index), one.pose.T_world_camera[:3, 3], atol=1e-14)


def test_drawn_path_correction_changes_pieces_of_moved_submap() -> None:
    path = DrawnPath()
    path.add(0, 0 * UP)
    path.correct(SubmapChange(submap=1))
    path.add(1, 1 * UP)
    path.add(2, 2 * UP)
    assert lines(path) == {0: [0, 1], 1: [1, 2]}
    assert lines(path) == {}
    path.correct(moved(1, 10))
    assert lines(path) == {1: [1, 12]}
    path.correct(moved(0, 5))
    assert lines(path) == {0: [5, 6], 1: [6, 12]}


def test_drawn_path_is_interrupted_and_continued() -> None:
    path = DrawnPath()
    for k in range(PIECE + 1):
        path.add(k, k * UP)
    path.interrupt()
    path.add(PIECE + 2, 0 * UP)
    assert lines(path) == {0: list(range(PIECE)), 1: [PIECE - 1, PIECE], 2: [0]}


def test_drawn_path_position_of_missing_frame_is_none() -> None:
    path = DrawnPath()
    path.add(3, np.array([1.0, 2.0, 3.0]))
    assert path.position(4) is None
    np.testing.assert_array_equal(path.position(3), [1.0, 2.0, 3.0])
