"""Tests for the statistics of the views of an instance."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
import pytest

from framework.geometry import exp_se3
from framework.mapping.instances.viewing import Viewing

CENTER = (0.0, 0.0, 2.0)


def seen_from(*cameras: tuple[float, float, float]) -> int:
    """Return the number of views of an object at CENTER from these camera centers."""
    viewing = Viewing()
    viewing.locate(CENTER)
    for camera in cameras:
        viewing.see(camera)
    return viewing.views


def test_views_of_standing_camera_count_once():
    assert seen_from(*[(0.001 * k, 0.0, 0.0) for k in (0, 1, 0, -1, 0, 1)]) == 1


def test_view_from_another_direction_is_new():
    assert seen_from((0.0, 0.0, 0.0), (0.3, 0.0, 0.0)) == 1, "8.5 degrees"
    assert seen_from((0.0, 0.0, 0.0), (0.4, 0.0, 0.0)) == 2, "11.3 degrees"


def test_view_from_another_distance_is_new():
    assert seen_from((0.0, 0.0, 0.0), (0.0, 0.0, 0.35)) == 1
    assert seen_from((0.0, 0.0, 0.0), (0.0, 0.0, 0.45)) == 2


def test_views_of_slow_motion_add_up():
    """A quarter of a circle in steps of 1 degree has a new view every 10 degrees."""
    path = [(2 * sin(radians(k)), 0.0, 2 - 2 * cos(radians(k))) for k in range(91)]
    assert 8 <= seen_from(*path) <= 10


def test_outline_is_mean_of_detections():
    viewing = Viewing()
    assert viewing.outline is None
    viewing.detect(0.5)
    viewing.detect(0.8)
    assert viewing.outline == pytest.approx(0.65)


def test_merged_viewing_adds_detections():
    one, other = Viewing(), Viewing()
    one.detect(0.5)
    other.detect(0.9)
    other.locate(CENTER)
    other.see((0.0, 0.0, 0.0))
    one.merge(other)
    assert one == Viewing(1, 2, 1.4, 1, CENTER, (0.0, 0.0, 0.0))


def test_moved_viewing_has_views_of_moved_cameras():
    T = exp_se3(np.array([1.0, -2.0, 0.5, 0.3, -0.7, 0.2]))
    viewing, expected = Viewing(), Viewing()
    for center, camera in (((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)), ((0.2, 0.1, 1.9), (0.9, 0.0, 0.1))):
        viewing.locate(center)
        expected.locate(tuple(T[:3, :3] @ center + T[:3, 3]))
        viewing.see(camera)
        expected.see(tuple(T[:3, :3] @ camera + T[:3, 3]))
    moved = viewing.moved(T)
    assert (moved.views, moved.centered) == (expected.views, expected.centered) == (2, 2)
    assert moved.center == pytest.approx(expected.center)
    assert moved.camera == pytest.approx(expected.camera)
    assert Viewing().moved(T) == Viewing()
