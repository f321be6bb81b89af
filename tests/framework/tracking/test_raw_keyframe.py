"""Tests for the raw keyframe as a model for alignment."""

from __future__ import annotations

import numpy as np
import pytest

from framework.geometry import exp_se3, inverse
from framework.tracking.alignment import Weights
from framework.tracking.depth_scale import DepthScale
from framework.tracking.pyramid import PyramidLevel, build_pyramid
from framework.tracking.raw_keyframe import NEW_DISTANCE, USED_DISTANCE, KeyframeTerm, RawKeyframe
from plugins.trackers.voxel_hashing_icp import _solved
from tests.support.scenes.analytic_scene import CAMERA, pose, room

WEIGHTS = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 0.1, 1.0)))
T_KEY = pose(0.0, 0.0, 0.0, (0.0, 0.0, 0.0))


def pyramid(T_world_camera: np.ndarray) -> list[PyramidLevel]:
    frame = room().frame(T_world_camera)
    return build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_keyframe_term_step_recovers_pose_from_any_view(level: int) -> None:
    T_world_view, T_world_camera = (
        pose(0.02, -0.03, 0.01, (0.02, -0.01, 0.03)),
        pose(0.03, -0.02, 0.0, (0.01, 0.02, 0.0)),
    )
    term = KeyframeTerm.at(RawKeyframe.of(pyramid(T_KEY), T_KEY), T_world_view, DepthScale())
    assert term is not None
    truth = inverse(T_world_view) @ T_world_camera
    T_view_camera = exp_se3(np.array([0.004, -0.003, 0.002, 0.002, 0.001, -0.002])) @ truth
    before = np.linalg.norm((inverse(truth) @ T_view_camera)[:3, 3])
    for _ in range(4):
        equations = term.linearized(pyramid(T_world_camera), level, T_view_camera, WEIGHTS, 0.0, None)
        T_view_camera = exp_se3(_solved(equations.A, equations.b)) @ T_view_camera
    assert np.linalg.norm((inverse(truth) @ T_view_camera)[:3, 3]) < 0.3 * before


def test_keyframe_term_at_finest_level_is_scaled_by_point_ratio() -> None:
    term = KeyframeTerm.at(RawKeyframe.of(pyramid(T_KEY), T_KEY), T_KEY, DepthScale())
    assert term is not None
    levels = pyramid(T_KEY)
    finest, half = (term.linearized(levels, level, np.eye(4), WEIGHTS, 0.0, None) for level in (0, 1))
    np.testing.assert_allclose(finest.A, 4 * half.A)
    np.testing.assert_allclose(finest.b, 4 * half.b)


@pytest.mark.parametrize(
    ("offset", "weight"),
    [(0.0, 1.0), (NEW_DISTANCE, 1.0), (0.5 * (NEW_DISTANCE + USED_DISTANCE), 0.5), (USED_DISTANCE, None), (1.0, None)],
)
def test_keyframe_term_weight_decreases_with_distance(offset: float, weight: float | None) -> None:
    keyframe = RawKeyframe.of(pyramid(T_KEY), T_KEY)
    for xi in ([offset, 0, 0, 0, 0, 0], [0, 0, 0, 0, offset, 0]):
        term = KeyframeTerm.at(keyframe, T_KEY @ exp_se3(np.array(xi, np.float64)), DepthScale())
        assert (term and term.weight) == (None if weight is None else pytest.approx(weight))
    assert KeyframeTerm.at(None, T_KEY, DepthScale()) is None
