"""One step of the alignment, term by term and level by level, between two exact views of a scene."""

import dataclasses

import numpy as np
import pytest

from framework.data import Frame
from framework.geometry import exp_se3, inverse
from framework.mapping.sensor import depth_noise
from framework.tracking.alignment import ModelView, NormalEquations, Weights, linearize
from framework.tracking.pyramid import build_pyramid, model_intensities
from plugins.trackers.voxel_hashing_icp import _solved
from tests.analytic_scene import CAMERA, Scene, pose

WALL = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=1.0)
COLOR = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 1.0, 0.0)))
DEPTH = Weights(*map(np.float32, (0.1, 0.05, 0.7, 4.0, 4.0, 0.05, 0.0, 1.0)))
T_VIEW = pose(0.02, -0.03, 0.01, (0.01, 0.02, -0.01))


def step(
    scene: Scene, frame: Frame, level: int, T_view_camera: np.ndarray, weights: Weights, brightness: float = 0.0
) -> tuple[np.ndarray, NormalEquations]:
    """The Gauss-Newton step (6,) from T_view_camera at a level, and its equations; the model is seen from T_VIEW."""
    view_frame = scene.frame(T_VIEW)
    depth = view_frame.depth
    gap = inverse(T_VIEW)[:3, :3]
    _, _, surface = scene.render(CAMERA, T_VIEW)
    normals = np.zeros((*depth.shape, 3), np.float32)
    for k, (n, _) in enumerate(scene.planes, start=1):
        normals[surface == k] = gap @ n
    depth = np.where(surface <= len(scene.planes), depth, 0).astype(np.float32)
    f, c = (np.float32(CAMERA.fx), np.float32(CAMERA.fy)), (np.float32(CAMERA.cx), np.float32(CAMERA.cy))
    model = ModelView(depth, np.ascontiguousarray(normals.transpose(2, 0, 1)), *f, *c)
    view = dataclasses.make_dataclass("Seen", ["color", "depth"])(view_frame.color, depth)
    intensity = model_intensities(view, 3)[level]
    pyramid = build_pyramid(CAMERA, frame.depth, frame.color, 1.0, 3)
    equations = linearize(pyramid[level], model, intensity, T_view_camera, weights, brightness)
    return _solved(equations), equations


@pytest.mark.parametrize("level", [0, 1, 2])
def test_color_at_the_true_pose_asks_for_no_step(level: int) -> None:
    """A shift of half a pixel between the levels of frame and model would be a step of several millimetres."""
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


def test_depth_noise_is_nguyens() -> None:
    assert depth_noise(np.float32(0.4)) == pytest.approx(0.0012)
    assert depth_noise(np.float32(3.4)) == pytest.approx(0.0012 + 0.0019 * 9)
