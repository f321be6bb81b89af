"""Tests for changes during a synthetic sequence."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from framework.data import Frame
from framework.geometry import inverse, rotation_angle
from framework.synthetic.dynamics import PAUSE, Dynamics
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic

pytestmark = pytest.mark.integration


def sequence(dynamics: Dynamics, **parameters: object) -> Synthetic:
    size = {"kind": RoomKind.KITCHEN, "seed": 2, "width": 160, "height": 120}
    return Synthetic(dynamics=dynamics, **(size | parameters))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def steady() -> Synthetic:
    return sequence(Dynamics.NONE)


def differing(one: Frame, other: Frame) -> float:
    """Return the fraction of pixels with another depth."""
    return float((one.depth != other.depth).mean())


def test_person_is_in_frames_but_not_in_scene_truth(steady: Synthetic) -> None:
    walking = sequence(Dynamics.PERSON, noise=0.0)
    exact = sequence(Dynamics.NONE, noise=0.0)
    person = max(walking.class_names) + 1
    for k in (0, 60, 120):
        frame, without = walking[k], exact[k]
        assert frame.truth is not None
        own = frame.truth.instance_ids == person
        assert frame.truth.class_names[person] == "person"
        assert 0.02 < own.mean() < 0.3
        assert (frame.depth[own] < without.depth[own]).all()
        np.testing.assert_array_equal(frame.depth[~own], without.depth[~own])
        np.testing.assert_array_equal(frame.color[~own], without.color[~own])
        np.testing.assert_array_equal(frame.T_world_camera, without.T_world_camera)
    assert person not in walking.scene_truth().class_names
    assert walking.class_names == steady.class_names


def test_person_walks_at_most_2_m_per_s() -> None:
    moving = sequence(Dynamics.PERSON).moving
    assert moving is not None
    centers = np.array([moving.vertices_at(k)[:, :2].mean(axis=0) for k in range(240)])
    speed = 30 * np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert speed.mean() > 0.5
    assert speed.max() < 2.1
    heights = moving.vertices_at(30)[:, 2]
    assert -0.1 < heights.min() < 0.1
    assert 1.7 < heights.max() < 1.8


def test_door_leaf_turns_about_hinge() -> None:
    moving = sequence(Dynamics.DOOR).moving
    assert moving is not None
    closed, opened = moving.vertices_at(0), moving.vertices_at(90)  # half of the period
    step = np.linalg.norm(opened - closed, axis=1)
    assert step.min() < 0.01
    assert 0.9 < step.max() < 1.2  # 0.84 m wide, 80 degrees
    np.testing.assert_allclose(opened[:, 2], closed[:, 2], atol=1e-5)
    inward = np.linalg.norm(opened[:, :2].mean(axis=0)) - np.linalg.norm(closed[:, :2].mean(axis=0))
    assert inward < 0


def test_closed_door_equals_static_door() -> None:
    exact = {"noise": 0.0, "kind": RoomKind.KITCHEN}
    assert differing(sequence(Dynamics.DOOR, **exact)[0], sequence(Dynamics.NONE, **exact)[0]) < 0.001


def test_lights_change_only_color(steady: Synthetic) -> None:
    dark = sequence(Dynamics.LIGHTS)
    assert dark[75].color.mean() < 0.8 * steady[75].color.mean()
    np.testing.assert_array_equal(dark[75].depth, steady[75].depth)


def test_paused_camera_stands_still(steady: Synthetic) -> None:
    paused = sequence(Dynamics.PAUSE)
    poses = [paused[k].T_world_camera for k in (PAUSE - 1, PAUSE, 2 * PAUSE - 1, 2 * PAUSE, 2 * PAUSE + 1)]
    steps = [rotation_angle((inverse(a) @ b)[:3, :3]) for a, b in pairwise(poses)]
    assert steps[1] == steps[2] == 0
    assert min(steps[0], steps[3]) > 1e-3
    np.testing.assert_array_equal(paused[2 * PAUSE + 1].T_world_camera, steady[PAUSE + 1].T_world_camera)
