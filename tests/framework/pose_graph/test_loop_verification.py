"""Tests for the verification of loops, in exact scenes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.geometry import exp_se3, pose_distance
from framework.pose_graph.loop_verification import LoopVerification, match_hidden, overlaps
from tests.support.scenes.analytic_scene import CAMERA, Scene, pose, room
from tests.support.scenes.hidden_submaps import HiddenSubmaps


def submaps(*scenes: Scene) -> HiddenSubmaps:
    """Return a map whose submap k is scene k."""
    return HiddenSubmaps({k: (partial(_frame, scene), np.eye(4)) for k, scene in enumerate(scenes)})


def _frame(scene: Scene, T_scene_camera: np.ndarray, camera: Camera) -> Frame:
    return scene.frame(T_scene_camera, camera=camera)


def accepted(frame: Frame, T_world_guess: np.ndarray, *scenes: Scene) -> bool:
    match = match_hidden(frame, T_world_guess, submaps(*scenes), range(len(scenes)))
    return match is not None and LoopVerification().accepts(match)


def test_match_revisited_place_is_accepted() -> None:
    T = pose(0.1, 0, 0.1, (0, 0.1, 0))
    assert accepted(room().frame(T), T, room())


@pytest.mark.parametrize("offset", [(0.1, 0, 0, 0, 0, 0), (0, 0.05, -0.1, 0.02, 0.05, 0.02)])
def test_match_inaccurate_guess_converges(offset: tuple[float, ...]) -> None:
    T = pose(0.1, 0, 0.1, (0, 0.1, 0))
    match = match_hidden(room().frame(T), T @ exp_se3(np.array(offset)), submaps(room()), [0])
    assert match is not None
    assert LoopVerification().accepts(match)
    assert pose_distance(match.T_world_camera, T) < 0.005


def test_match_other_place_is_rejected() -> None:
    other = room()
    other.spheres = [(np.array([0.4, 0.2, 1.7]), 0.35), (np.array([-0.6, -0.1, 1.5]), 0.3)]
    assert not accepted(room().frame(pose()), pose(), other)


def test_match_featureless_wall_is_rejected() -> None:
    wall = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -2.0)], contrast=0)
    match = match_hidden(wall.frame(pose()), pose(0.05), submaps(wall), [0])
    assert match is not None
    assert match.agreement > 0.99
    assert not LoopVerification().accepts(match)


def test_match_surface_in_front_of_frame_is_rejected() -> None:
    curtain = Scene(planes=room().planes, spheres=[*room().spheres, (np.array([-0.35, -0.35, 1.0]), 0.2)])
    assert not accepted(room().frame(pose()), pose(), curtain)
    assert accepted(curtain.frame(pose()), pose(), curtain)


def test_match_without_mapped_surface_is_none() -> None:
    T = pose(0, 0, 0, (0, np.pi, 0))
    empty = HiddenSubmaps({})
    assert match_hidden(room().frame(T), T, empty, [0]) is None
    assert match_hidden(replace(room().frame(T), depth=np.zeros(CAMERA.shape, np.float32)), T, empty, [0]) is None


def test_overlaps_are_those_of_each_submap() -> None:
    wall, rest = Scene(planes=room().planes[:1]), Scene(planes=room().planes[1:], spheres=room().spheres)
    found = overlaps(room().frame(pose()), pose(), submaps(wall, rest), [0, 1, 7])
    assert found[7] == 0
    assert min(found[0], found[1]) > 0.1
    assert found[0] + found[1] == pytest.approx(1, abs=0.02)
