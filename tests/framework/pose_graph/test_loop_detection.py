"""Tests for the detection of loops, in a room with image features."""

from __future__ import annotations

import numpy as np
import pytest

from framework.geometry import exp_se3, inverse, pose_distance
from framework.pose_graph.graph_optimization import GraphEdge
from framework.pose_graph.loop_detection import VALID_VIEWS, Drift, Guess, Loop, LoopDetection, QueryView, Reach
from framework.pose_graph.submap_anchors import Submap
from tests.support.scenes.papered_room import papered_frame

DRIFT = exp_se3(np.array([0.3, 0.1, -0.1, 0, 0.1, 0.0]))  # of the second submap


def turned(yaw: float, x: float = 0) -> np.ndarray:
    return exp_se3(np.array([x, 0, 0, 0, yaw, 0]))


def submap(number: int, T_world_anchor: np.ndarray) -> Submap:
    return Submap(number, T_world_anchor)


def query(number: int, T_true: np.ndarray, where: Submap, *reaches: Reach) -> QueryView:
    return QueryView(number, papered_frame(T_true, number), where, where.local(DRIFT @ T_true), True, reaches)


@pytest.fixture(scope="module")
def first() -> Submap:
    """Return a submap with keyframes in all directions."""
    found, detection = submap(0, np.eye(4)), LoopDetection()
    for k, yaw in enumerate(np.linspace(0, 2 * np.pi, 12, endpoint=False)):
        view = QueryView(k, papered_frame(turned(yaw), k), found, turned(yaw), True, ())
        keyframe = detection.extract(view).keyframe
        assert keyframe is not None
        found.keyframes.append(keyframe)
    return found


def guesses(first: Submap, T_true: np.ndarray, drift: Drift) -> list[Guess]:
    second = submap(1, DRIFT)
    return LoopDetection().extract(query(20, T_true, second, Reach(first, DRIFT @ T_true, 20, drift, 1))).guesses


def test_extract_revisited_place_is_located(first: Submap) -> None:
    T_true = turned(1.1, 0.3)
    (guess,) = guesses(first, T_true, LoopDetection().drift(20))
    assert pose_distance(guess.T_world_camera, T_true) < 0.03


def test_extract_implausible_pose_is_no_guess(first: Submap) -> None:
    assert not guesses(first, turned(1.1, 0.3), Drift(0.05, 1.0))


def test_extract_keyframe_in_other_direction_is_not_matched(first: Submap) -> None:
    """Identical rooms on the other side of a corridor look the same, but in the opposite direction."""
    opposite = submap(0, turned(np.pi))
    opposite.keyframes = first.keyframes
    T_true = turned(1.1)
    reach = Reach(opposite, inverse(opposite.T_world_anchor) @ T_true, 20, LoopDetection().drift(20), 1)
    assert not LoopDetection().extract(query(20, T_true, submap(1, np.eye(4)), reach)).guesses


def loop(view: int, correction: np.ndarray) -> Loop:
    return Loop(view, 0, np.eye(4), GraphEdge.loop(0, 1, correction), frozenset({0}), view, 20.0)


def test_agreeing_single_loop_is_not_accepted() -> None:
    submaps = [submap(0, np.eye(4)), submap(1, np.eye(4))]
    assert not LoopDetection().agreeing(loop(1, DRIFT), submaps, turned(0))


def test_agreeing_second_loop_accepts_both() -> None:
    submaps, detection = [submap(0, np.eye(4)), submap(1, np.eye(4))], LoopDetection()
    other, same = loop(1, np.eye(4)), [loop(2, DRIFT), loop(3, DRIFT @ turned(0.01, 0.02))]
    found = [detection.agreeing(one, submaps, turned(0, 3)) for one in (other, *same, other)]
    assert found == [[], [], same, []]


def test_agreeing_old_loop_is_discarded() -> None:
    submaps, detection = [submap(0, np.eye(4)), submap(1, np.eye(4))], LoopDetection()
    assert not detection.agreeing(loop(1, DRIFT), submaps, turned(0))
    assert not detection.agreeing(loop(2 + VALID_VIEWS, DRIFT), submaps, turned(0))


def test_drift_grows_with_path() -> None:
    detection = LoopDetection(max_drift=0.02)
    assert detection.drift(0) == (0.2, 0.05)
    assert detection.drift(100) == pytest.approx((2.2, 0.45))
