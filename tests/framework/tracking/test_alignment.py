"""One step of the alignment, term by term and level by level, between two exact views of a scene."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from framework.data import Frame
from framework.geometry import exp_se3, inverse
from framework.tracking.alignment import ModelView, NormalEquations, Weights, linearize, smoothed
from framework.tracking.pyramid import build_pyramid, intrinsics, model_intensities
from plugins.trackers.voxel_hashing_icp import _solved
from tests.support.scenes.analytic_scene import CAMERA, Scene, pose

WALL = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
COLOR = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 1.0, 0.0)))
DEPTH = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 0.0, 1.0)))
T_VIEW = pose(0.02, -0.03, 0.01, (0.01, 0.02, -0.01))


def step(
    scene: Scene,
    frame: Frame,
    level: int,
    T_view_camera: np.ndarray,
    weights: Weights,
    brightness: float = 0.0,
    seen: Callable[[ModelView], ModelView] = lambda model: model,
) -> tuple[np.ndarray, NormalEquations]:
    """The Gauss-Newton step (6,) from T_view_camera at a level, and its equations.

    The model is seen from T_VIEW, as `seen` has it.
    """
    view_frame = scene.frame(T_VIEW)
    depth = view_frame.depth
    gap = inverse(T_VIEW)[:3, :3]
    _, _, surface = scene.render(CAMERA, T_VIEW)
    normals = np.zeros((*depth.shape, 3), np.float32)
    for k, (n, _) in enumerate(scene.planes, start=1):
        normals[surface == k] = gap @ n
    depth = np.where(surface <= len(scene.planes), depth, 0).astype(np.float32)
    model = ModelView(depth, np.ascontiguousarray(normals.transpose(2, 0, 1)), *intrinsics(CAMERA))
    model = seen(model)
    view = dataclasses.make_dataclass("Seen", ["color", "depth"])(view_frame.color, depth)
    intensity = model_intensities(view, 3)[level]
    pyramid = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)
    equations = linearize(pyramid[level], model, intensity, T_view_camera, weights, brightness)
    return _solved(equations), equations


@pytest.mark.parametrize("level", [0, 1, 2])
def test_color_at_the_true_pose_asks_for_no_step(level: int) -> None:
    """A shift of half a pixel between the levels of frame and model would be a step of several millimeters."""
    T = pose(0.03, -0.02, 0.01, (0.01, 0.02, -0.01))
    xi, equations = step(WALL, WALL.frame(T), level, inverse(T_VIEW) @ T, COLOR)
    assert equations.matched > 0.5 * CAMERA.width * CAMERA.height / 4**level
    assert np.abs(xi[:2] + 1.5 * np.array([xi[4], -xi[3]])).max() < 2e-3, "on the wall, m"


@pytest.mark.parametrize("level", [0, 1, 2])
def test_one_step_of_color_finds_a_small_motion(level: int) -> None:
    T = pose(0.026, -0.026, 0.01, (0.01, 0.02, -0.01))
    truth = inverse(T_VIEW) @ T
    xi, _ = step(WALL, WALL.frame(T), level, np.eye(4), COLOR)
    error = exp_se3(xi) @ np.array([0, 0, 1.5, 1]) - truth @ np.array([0, 0, 1.5, 1])
    before = np.array([0, 0, 1.5, 1]) - truth @ np.array([0, 0, 1.5, 1])
    assert np.linalg.norm(error[:2]) < 0.3 * np.linalg.norm(before[:2])


def test_a_change_of_exposure_is_told_and_taken_out() -> None:
    T = pose(0.03, -0.02, 0.01, (0.01, 0.02, -0.01))
    frame = WALL.frame(T)
    brighter = dataclasses.replace(frame, color=np.clip(frame.color * 0.8 + 40.0, 0, 255).astype(np.uint8))
    darker = dataclasses.replace(frame, color=(frame.color * 0.8).astype(np.uint8))
    truth = inverse(T_VIEW) @ T
    _, plain = step(WALL, darker, 0, truth, COLOR)
    _, first = step(WALL, brighter, 0, truth, COLOR)
    assert first.brightness - plain.brightness == pytest.approx(40 / 255, abs=0.003)
    _, second = step(WALL, brighter, 0, truth, COLOR, first.brightness)
    _, alike = step(WALL, darker, 0, truth, COLOR, plain.brightness)
    assert second.brightness == first.brightness
    assert second.matched == pytest.approx(alike.matched, rel=0.01), "what is brighter all over is no outlier"
    np.testing.assert_allclose(second.A, alike.A, rtol=0.05, atol=0.01 * np.abs(alike.A).max())


@pytest.mark.parametrize("level", [0, 1, 2])
def test_one_step_of_depth_finds_a_motion_between_planes(level: int) -> None:
    corner = Scene(
        planes=[(np.array([0, 0, -1.0]), -1.8), (np.array([0, -0.8, -0.6]), -1.2), (np.array([0.8, 0, -0.6]), -1.4)]
    )
    T = T_VIEW @ exp_se3(np.array([0.01, -0.005, 0.008, 0.004, -0.003, 0.005]))
    truth = inverse(T_VIEW) @ T
    xi, equations = step(corner, corner.frame(T), level, np.eye(4), DEPTH)
    left = inverse(exp_se3(xi)) @ truth
    assert np.linalg.norm(left[:3, 3]) < 0.15 * np.linalg.norm(truth[:3, 3])
    assert equations.matched > 0.8 * equations.visible


def test_points_whose_normals_differ_do_not_match() -> None:
    """A wall against the same wall turned by 60 degrees: near each other along the axis, and not one surface."""
    n = np.array([np.sin(np.pi / 3), 0.0, -np.cos(np.pi / 3)])
    turned = Scene(planes=[(n, n @ np.array([0.0, 0.0, 1.5]))])
    _, equations = step(WALL, turned.frame(T_VIEW), 0, np.eye(4), DEPTH)
    assert equations.visible > 1000
    assert equations.matched == 0
    _, open_gate = step(WALL, turned.frame(T_VIEW), 0, np.eye(4), DEPTH._replace(min_normal_dot=np.float32(0.3)))
    assert open_gate.matched > 100


def with_noisy_normals(model: ModelView) -> ModelView:
    """As a map of one frame has them, a few meters away."""
    noisy = model.normals + np.random.default_rng(0).normal(0, 0.5, model.normals.shape).astype(np.float32)
    noisy /= np.linalg.norm(noisy, axis=0)
    return model._replace(normals=np.where(model.depth > 0, noisy, 0).astype(np.float32))


@pytest.mark.parametrize("level", [1, 2])
def test_noisy_normals_do_not_resist_a_motion_along_a_wall(level: int) -> None:
    """A wall says nothing about motions along it, a slanted one at the border of the picture says it all."""
    room = Scene(planes=[(np.array([0, 0, -1.0]), -2.0), (np.array([-0.8, 0, -0.6]), -1.95)])
    T = T_VIEW @ exp_se3(np.array([0.02, 0, 0, 0, 0, 0]))
    weights = DEPTH._replace(max_distance=np.float32(0.3), geometric_scale=np.float32(16))

    def share_found(seen: Callable[[ModelView], ModelView]) -> float:
        xi, _ = step(room, room.frame(T), level, np.eye(4), weights, seen=seen)
        return float(xi[0] / 0.02)

    assert share_found(lambda model: model) == pytest.approx(1, abs=0.02)
    assert share_found(with_noisy_normals) < 0.8, "this case does not show what it is for"
    assert share_found(lambda model: smoothed(with_noisy_normals(model), level)) == pytest.approx(1, abs=0.1)


def test_smoothed_normals_are_means_of_squares_without_what_is_not_mapped() -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(0, 1, (3, 12, 17)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=0)
    hole = rng.random((12, 17)) < 0.3
    normals[:, hole] = 0
    model = ModelView((~hole).astype(np.float32), normals, *map(np.float32, (9, 9, 8, 6)))
    assert smoothed(model, 0) is model
    for level, reach in ((1, 1), (2, 3)):
        found = smoothed(model, level)
        np.testing.assert_array_equal(found.depth, model.depth)
        for v in range(reach, 12 - reach):
            for u in range(reach, 17 - reach):
                total = normals[:, v - reach : v + reach + 1, u - reach : u + reach + 1].sum(axis=(1, 2))
                np.testing.assert_allclose(found.normals[:, v, u], total / np.linalg.norm(total), atol=1e-4)
