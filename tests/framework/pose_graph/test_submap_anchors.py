"""Tests for the division of the trajectory into submaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Frame
from framework.errors import ConfigError
from framework.pose_graph.submap_anchors import DepthSamples, SubmapAnchors
from tests.support.scenes.analytic_scene import Scene, pose, room

FRAME = room().frame(pose())


def frame(index: int) -> Frame:
    return replace(FRAME, index=index)


def walked(anchors: SubmapAnchors, positions: np.ndarray) -> list[int]:
    """Return the current submap at each position along x."""
    current = []
    for k, x in enumerate(positions):
        anchors.divide(frame(k), pose(x))
        anchors.submaps[anchors.current].add_view(frame(k), pose(x))
        anchors.hide_distant(pose(x))
        current.append(anchors.current)
    return current


def test_divide_far_from_anchor_begins_submap() -> None:
    anchors = SubmapAnchors(begin_distance=2.5)
    assert walked(anchors, np.arange(0, 6.5)) == [0, 0, 0, 1, 1, 1, 2]
    assert [submap.T_world_anchor[0, 3] for submap in anchors.submaps] == [0, 3, 6]


def test_divide_near_visible_anchor_enters_it_again() -> None:
    anchors = SubmapAnchors(begin_distance=2.5)
    there = np.arange(0, 5.5)
    assert walked(anchors, [*there, *there[::-1]])[-1] == 0
    assert len(anchors.submaps) == 2


def test_divide_anchor_behind_wall_begins_submap() -> None:
    anchors = SubmapAnchors(begin_distance=2.5)
    walked(anchors, np.arange(0, 3.5))
    wall = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -0.5)]).frame(pose())
    assert anchors.divide(wall, pose(0))
    assert anchors.current == 2


def test_resumed_map_is_neither_entered_nor_hidden() -> None:
    anchors = SubmapAnchors(begin_distance=2.5, hide_distance=6)
    anchors.resume()
    assert walked(anchors, [0, 1, *np.arange(1, 20.0), *np.arange(20.0)[::-1]])[:2] == [1, 1]
    assert not anchors.submaps[0].hidden
    assert anchors.submaps[1].hidden


def test_divide_near_hidden_anchor_begins_submap() -> None:
    anchors = SubmapAnchors(begin_distance=2.5, hide_distance=6)
    there = np.arange(0, 20.0)
    assert walked(anchors, [*there, *there[::-1]])[-1] == len(anchors.submaps) - 1
    assert anchors.submaps[0].hidden


def test_hide_distant_measures_distance_to_nearest_view() -> None:
    anchors = SubmapAnchors(begin_distance=2.5, hide_distance=6)
    walked(anchors, np.arange(0, 8.25, 0.25))
    assert not anchors.hidden()  # the last view of submap 0 is at 2.5 m
    assert anchors.hide_distant(pose(8.75)) == {0}
    assert [submap.number for submap in anchors.visible()] == [1, 2]


def test_anchors_in_small_place_hide_nothing() -> None:
    anchors = SubmapAnchors()
    angles = np.linspace(0, 40, 2000)
    for k, angle in enumerate(angles):
        T_world_camera = pose(2.5 * np.cos(angle), 0, 2.5 * np.sin(angle), (0, angle, 0))
        anchors.divide(frame(k), T_world_camera)
        anchors.submaps[anchors.current].add_view(frame(k), T_world_camera)
        assert not anchors.hide_distant(T_world_camera)
    assert len(anchors.submaps) <= 8


def test_add_view_similar_view_is_not_added() -> None:
    anchors = SubmapAnchors()
    anchors.divide(frame(0), pose())
    submap = anchors.submaps[0]
    added = [
        submap.add_view(frame(k), T) for k, T in enumerate([pose(), pose(0.3), pose(0.6), pose(0, 0, 0, (0, 0.6, 0))])
    ]
    assert added == [False, False, True, True]
    assert submap.nearest_view(pose(0.5)) == 1
    assert submap.distance(pose(1.6)) == pytest.approx(1.0)


def test_hide_distance_below_begin_distance_raises() -> None:
    with pytest.raises(ConfigError, match="hide_distance: expected more than begin_distance"):
        SubmapAnchors(begin_distance=3, hide_distance=3)


def test_coverage_is_fraction_of_samples_near_points() -> None:
    anchors = SubmapAnchors()
    anchors.divide(frame(0), pose(1))
    submap, samples = anchors.submaps[0], DepthSamples.of(FRAME)
    assert submap.coverage(samples, np.eye(4), 0) == 1
    assert submap.coverage(samples, pose(0.1), 0.2) > 0.8
    assert submap.coverage(samples, pose(0, 0, -1), 0) < 0.2
    assert submap.coverage(samples, pose(0, 0, 0, (0, np.pi, 0)), 0) == 0
