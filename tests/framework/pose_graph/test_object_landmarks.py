"""Tests for objects as landmarks, against exact positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from framework.data import Camera, View
from framework.geometry import exp_se3, inverse, pose_distance, transform
from framework.interfaces import SubmapChange
from framework.pose_graph.graph_optimization import GraphEdge, optimize
from framework.pose_graph.loop_detection import Loop
from framework.pose_graph.object_landmarks import (
    CELL,
    ObjectLandmarks,
    ObservedObject,
    object_edges,
    observed_objects,
    shared_objects,
)
from framework.pose_graph.submap_anchors import Submap, SubmapAnchors
from framework.testing.corner_room import CAMERA, SPHERES, RoomMap, pose_at

FIRST = exp_se3(np.array([1.0, 0, 0, 0, 0.3, 0]))
SECOND = exp_se3(np.array([2.0, 0.5, 0, 0.1, 1.2, 0]))
TURN = exp_se3(np.array([0, 0, 0, 0.02, -0.04, 0.03]))
POSITIONS = np.array([[0, 0, 0], [1, 0, 0.5], [2, 0.4, 1], [0.5, -0.6, 2], [1.5, 0.2, 3.0]])  # m, world frame


def observed(submap: int, T_world_anchor: np.ndarray, positions: np.ndarray = POSITIONS) -> list[ObservedObject]:
    """Return objects of one class with exact positions. The submap is in their instance ids."""
    local = transform(inverse(T_world_anchor), positions)
    return [ObservedObject(submap, 100 * submap + k, 0, p, 0.2, 50) for k, p in enumerate(local)]


def test_object_edges_aligns_exact_positions() -> None:
    (edge,) = object_edges(observed(0, FIRST), observed(1, SECOND), [FIRST, SECOND @ TURN])
    assert (edge.first, edge.second, edge.objects) == (0, 1, 5)
    assert pose_distance(edge.T_first_second, inverse(FIRST) @ SECOND) < 1e-6


def test_object_edges_wrong_position_has_little_weight() -> None:
    wrong = POSITIONS.copy()
    wrong[2] += (0, 0.29, 0)
    (edge,) = object_edges(observed(0, FIRST, wrong), observed(1, SECOND), [FIRST, SECOND])
    (equal,) = object_edges(observed(0, FIRST, wrong[[0, 1, 3, 4]]), observed(1, SECOND), [FIRST, SECOND])
    assert edge.objects == 5
    assert pose_distance(edge.T_first_second, equal.T_first_second) < 0.01


def test_object_edges_one_object_determines_three_degrees() -> None:
    (edge,) = object_edges(observed(0, FIRST, POSITIONS[2:3]), observed(1, SECOND, POSITIONS[2:3]), [FIRST, SECOND])
    assert np.linalg.matrix_rank(edge.information) == 3
    p_second = transform(inverse(SECOND), POSITIONS[2])
    turned = exp_se3(np.array([0, 0, 0, 0, 0.01, 0]))  # about the object
    step = p_second - transform(turned, p_second)
    rotation = np.array([0, 0.01, 0])
    assert np.abs(edge.information @ np.concatenate([rotation, step])).max() < 1e-2 * np.abs(edge.information).max()


def test_optimize_object_edge_moves_object_onto_itself() -> None:
    """The standard deviation of the drift, 0.6 m and 0.3 rad, is far larger than the noise of the object."""
    true, drift = exp_se3(np.array([30.0, 0, 0, 0, 0.5, 0])), exp_se3(np.array([0.1, -0.05, 0.08, 0, 0, 0]))
    anchors, one = [np.eye(4), true @ drift], true[:3, 3] + POSITIONS[2:3]
    edges = object_edges(observed(0, np.eye(4), one), observed(1, true, one), anchors)
    poses, kept = optimize(
        anchors, [GraphEdge.tracked(0, 1, true @ drift, np.diag(np.repeat([0.6, 0.3], 3) ** 2)), *edges]
    )
    p_second = transform(inverse(true), one[0])
    assert np.linalg.norm(transform(poses[1], p_second) - one[0]) < 0.01
    assert len(kept) == 2


@pytest.mark.parametrize("change", [{"class_id": 1}, {"position": np.full(3, 9.0)}, {"instance_id": 0}])
def test_shared_objects_other_object_is_not_shared(change: dict[str, object]) -> None:
    (one,), (other,) = observed(0, FIRST, POSITIONS[:1]), observed(1, SECOND, POSITIONS[:1])
    assert shared_objects([one], [other], [FIRST, SECOND])
    assert not shared_objects([one], [other._replace(**change)], [FIRST, SECOND])


def test_shared_objects_repeated_observations_count_once() -> None:
    """Two submaps of one visit observe the same object. The one that sees more of it is used."""
    (small,), (large,), (other,) = (observed(k, FIRST, POSITIONS[:1]) for k in range(3))
    large = large._replace(cells=60)
    (found,) = shared_objects([small, large], [other], [FIRST, FIRST, FIRST])
    assert found.first is large


@dataclass(frozen=True)
class Room(RoomMap):
    """A room whose instances are numbered from `first`."""

    first: int = 1

    def render_visible(self, camera: Camera, T_world_camera: np.ndarray) -> View:
        view = self.render(camera, T_world_camera)
        return replace(view, instance_ids=view.instance_ids + (self.first - 1) * (view.instance_ids > 0))

    def most_likely_classes(self) -> dict[int, tuple[int, float]]:
        return {self.first: (0, 0.9), self.first + 1: (1, 0.8)}


def views(number: int, T_world_anchor: np.ndarray, T_world_room: np.ndarray) -> Submap:
    """Return a submap with three views of the room."""
    cameras = [inverse(T_world_anchor) @ T_world_room @ pose_at(k) for k in (0, 20, 40)]
    return Submap(number, T_world_anchor, np.stack(cameras), [0, 20, 40])


def test_observed_objects_are_at_visible_surface() -> None:
    submap = views(3, FIRST, np.eye(4))
    found = observed_objects(submap, FIRST, CAMERA, Room(first=7))
    assert [(one.submap, one.instance_id, one.class_id) for one in found] == [(3, 7, 0), (3, 8, 1)]
    for one, (center, radius) in zip(found, SPHERES, strict=True):
        assert 0.3 * radius < np.linalg.norm(transform(FIRST, one.position) - center) < 0.8 * radius
        assert 0.4 * radius < one.radius < radius


def test_landmarks_returning_camera_connects_submaps() -> None:
    """The camera maps the room twice, the second time with drift."""
    drift = exp_se3(np.array([0.2, 0.1, -0.1, 0, 0.05, 0]))
    anchors, landmarks = SubmapAnchors(), ObjectLandmarks()
    anchors.submaps = [views(0, np.eye(4), np.eye(4)), views(1, drift @ SECOND, drift)]
    landmarks.observe(SubmapChange(hidden=frozenset({0}), submap=1), anchors.submaps, CAMERA, Room())
    anchors.submaps[0].hidden = True
    loop = Loop(90, 0, np.eye(4), GraphEdge.loop(0, 1, SECOND), frozenset({0}), 3, 20.0)
    (edge,) = landmarks.edges([loop], anchors, CAMERA, Room(T_world_room=drift, first=11))
    assert (edge.first, edge.second, edge.objects) == (0, 1, 2)
    for center, _ in SPHERES:
        p_second = transform(inverse(SECOND), np.array(center))
        assert np.linalg.norm(transform(edge.T_first_second, p_second) - center) < CELL


def test_landmarks_moved_submap_is_observed_where_it_was() -> None:
    """The map moves after the back end has moved the anchors."""
    step = exp_se3(np.array([0.5, 0, 0, 0, 0, 0]))
    landmarks, moved = ObjectLandmarks(), views(0, step, step)
    landmarks.observe(SubmapChange({0: step}, hidden=frozenset({0})), [moved], CAMERA, Room())
    resting = ObjectLandmarks()
    resting.observe(SubmapChange(hidden=frozenset({0})), [views(0, np.eye(4), np.eye(4))], CAMERA, Room())
    assert repr(landmarks.observed) == repr(resting.observed)
