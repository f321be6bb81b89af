"""Tests for the back end with a pose graph, on a path that leaves a room and returns with drift."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from framework.data import Camera, Frame, Pose
from framework.geometry import exp_se3, inverse, pose_distance, transform
from framework.interfaces import SubmapChange
from framework.pose_graph import object_landmarks
from framework.pose_graph.graph_optimization import GraphEdge, Optimized, optimize
from framework.pose_graph.loop_detection import LoopDetection
from framework.pose_graph.object_landmarks import ObservedObject
from framework.pose_graph.submap_anchors import Submap
from plugins.backends import pose_graph
from plugins.backends.pose_graph import PoseGraph
from tests.support.scenes.hidden_submaps import HiddenSubmaps
from tests.support.scenes.papered_room import CAMERA, HALF, papered_frame

DRIFT = exp_se3(np.array([0.25, 0.05, -0.1, 0.01, 0.04, 0.0]))  # after the path outside of the room
INSIDE = np.arange(-1, 1, 0.25)  # m, positions in the room
OUTSIDE = np.arange(1, 11, 0.5)  # m


@cache
def shown(x: float, paper: int, camera: Camera = CAMERA) -> Frame:
    return papered_frame(inside(x), paper=paper, camera=camera)


def room(T_room_camera: np.ndarray, camera: Camera) -> Frame:
    if (np.abs(T_room_camera[:3, 3]) < HALF).all():
        return papered_frame(T_room_camera, camera=camera)
    return Frame(0, 0, np.zeros((*camera.shape, 3), np.uint8), np.zeros(camera.shape, np.float32), camera, None)


def inside(x: float) -> np.ndarray:
    return exp_se3(np.array([x, 0, 0, 0, 0.5, 0.0]))


def journey(drift: np.ndarray) -> Iterator[tuple[Frame, np.ndarray]]:
    """Yield each frame and its tracked pose: in the room, outside, and in the room again with drift.

    Frames outside show another room. There, all drift is in the last step.
    """
    seen = [(shown(x, 0), inside(x)) for x in INSIDE]
    seen += [(shown(0, 1), inside(x)) for x in (*OUTSIDE, *OUTSIDE[::-1])]
    seen += [(shown(x, 0), drift @ inside(x)) for x in (*INSIDE[::-1], *INSIDE, *INSIDE[::-1])]
    for k, (frame, T_world_camera) in enumerate(seen):
        yield replace(frame, index=k), T_world_camera


def changes(back_end: PoseGraph, drift: np.ndarray = DRIFT) -> list[tuple[int, SubmapChange]]:
    """Return the changes on the journey by frame. The map of submap 0 is the room."""
    scene = HiddenSubmaps({0: (room, np.eye(4))})
    found, T_new_old, frame = [], np.eye(4), shown(0, 0)
    for frame, T_world_camera in journey(drift):
        change = back_end.update(frame, Pose(T_new_old @ T_world_camera), scene)
        if change is not None:
            found.append((frame.index, change))
            T_new_old = change.moved(change.submap, T_new_old)
    last = back_end.finish(scene)
    return [*found, (frame.index, last)] if last is not None else found


def test_backend_returning_camera_corrects_drift() -> None:
    back_end = PoseGraph(correction_delay=1)
    found = changes(back_end)
    corrections = [(frame, change) for frame, change in found if change.motions]
    assert len(corrections) == 1
    frame, change = corrections[0]
    assert {0} <= change.shown
    T_new_old = change.motions[back_end.anchors.current]
    T_world_camera = T_new_old @ DRIFT @ inside(0)
    assert pose_distance(T_world_camera, inside(0)) < 0.02
    assert 0 not in change.motions
    assert frame == back_end.loops[-1].frame + pose_graph.EXTRACTION_DELAY + 2 * back_end.correction_delay


def test_backend_graph_contains_loops_and_corrected_anchors() -> None:
    back_end = PoseGraph()
    changes(back_end)
    graph = back_end.graph()
    assert graph.anchors[0].first_frame == 0
    for anchor, submap in zip(graph.anchors, back_end.anchors.submaps, strict=True):
        np.testing.assert_array_equal(anchor.T_world_anchor, submap.T_world_anchor)
    assert len(graph.odometry) >= len(graph.anchors) - 1
    assert [(one.earlier_frame, one.frame, one.path) for one in graph.loops] == [
        (one.earlier_frame, one.frame, one.path) for one in back_end.loops
    ]
    assert all(loop.correction_deg == pytest.approx(np.degrees(np.hypot(0.01, 0.04)), abs=0.2) for loop in graph.loops)
    assert all(250 < loop.correction_mm < 300 for loop in graph.loops)


def test_backend_in_one_room_changes_nothing() -> None:
    back_end, scene = PoseGraph(), HiddenSubmaps({})
    for k in range(30):
        x = np.sin(k)
        assert back_end.update(papered_frame(inside(x), k), Pose(inside(x)), scene) is None
    assert back_end.finish(scene) is None


@pytest.mark.parametrize("max_drift", [0.03, 1])
def test_backend_implausible_drift_is_not_corrected(max_drift: float) -> None:
    """The camera is in an identical room next to the first one. The pose graph rejects loops that detection finds."""
    back_end = PoseGraph(detection=LoopDetection(max_drift=max_drift))
    found = changes(back_end, exp_se3(np.array([3.0, 0, 0, 0, 0, 0])))
    assert not any(change.motions or change.shown for _, change in found)
    assert not back_end.loops


def test_backend_loop_whose_confirmation_is_removed_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    corrections = []

    def one_loop_left(poses: Sequence[np.ndarray], edges: Sequence[GraphEdge]) -> Optimized:
        optimized = optimize(poses, edges)
        loops = [edge for edge in optimized.edges if edge.is_loop]
        corrections.append(len(loops))
        return Optimized(optimized.poses, [edge for edge in optimized.edges if edge not in loops[1:]])

    monkeypatch.setattr(pose_graph, "optimize", one_loop_left)
    back_end = PoseGraph(correction_delay=1)
    found = changes(back_end)
    assert set(corrections) == {2}  # a correction does not keep the loops of an earlier one
    assert len(corrections) > 1  # later views are verified
    assert not any(change.motions or change.shown for _, change in found)
    assert not back_end.loops


def test_backend_small_correction_shows_submaps_without_motion() -> None:
    nearly = exp_se3(np.array([0.002, 0, 0, 0, 0, 0]))
    shown = [change for _, change in changes(PoseGraph(), nearly) if change.shown]
    assert shown
    assert not any(change.motions for change in shown)


def test_backend_slow_threads_change_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    fast = changes(PoseGraph())
    extract = LoopDetection.extract
    monkeypatch.setattr(LoopDetection, "extract", lambda *view: time.sleep(0.02) or extract(*view))
    monkeypatch.setattr(pose_graph, "optimize", lambda *graph: time.sleep(0.5) or optimize(*graph))
    assert repr(changes(PoseGraph())) == repr(fast)


def test_backend_loop_at_the_end_is_corrected_by_finish() -> None:
    found = changes(PoseGraph(correction_delay=1000))
    last = found[-1][1]
    assert 0 in last.shown
    assert last.motions


def test_backend_logs_each_loop(caplog: pytest.LogCaptureFixture) -> None:
    back_end = PoseGraph()
    with caplog.at_level(logging.INFO):
        changes(back_end)
    lines = [one for one in caplog.messages if one.startswith("loop closed between frames")]
    assert len(lines) == len(back_end.loops) >= 2
    assert all("correction 2" in line and line.endswith("2.4 degrees") for line in lines)  # DRIFT


def test_backend_object_landmarks_confirm_the_loop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Three objects are mapped twice, before and after the drift."""
    positions = np.array([[0.5, 0, 1], [-0.5, 0.2, 1], [0, -0.4, -1]])
    returned = len(INSIDE) + 2 * len(OUTSIDE)  # first frame of the second visit

    def observed(submap: Submap, T_world_anchor: np.ndarray, *_: object) -> list[ObservedObject]:
        T_world_room = DRIFT if submap.frames[-1] >= returned else np.eye(4)
        local = transform(inverse(T_world_anchor) @ T_world_room, positions)
        return [ObservedObject(submap.number, 10 * submap.number + k, 0, p, 0.2, 9) for k, p in enumerate(local)]

    monkeypatch.setattr(object_landmarks, "observed_objects", observed)
    back_end = PoseGraph(object_landmarks=True)
    with caplog.at_level(logging.INFO):
        (change,) = [change for _, change in changes(back_end) if change.motions]
    assert any("3 objects are in both" in line for line in caplog.messages)
    T_new_old = change.motions[back_end.anchors.current]
    assert pose_distance(T_new_old @ DRIFT @ inside(0), inside(0)) < 0.02
