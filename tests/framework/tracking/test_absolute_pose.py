"""Tests for the estimation of an absolute pose from feature matches."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.errors import ConfigError
from framework.geometry import exp_se3, inverse, project, rotation_angle, transform
from framework.tracking.absolute_pose import AbsolutePoseEstimator

CAMERA = Camera(640, 480, 520.0, 530.0, 323.2, 236.1)
T_WORLD_CAMERA = exp_se3(np.array([0.4, -0.2, 1.0, 0.3, -0.6, 0.2]))


def matches(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels (N, 2), world points (N, 3), m, and depths (N,), m, of exact matches."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1, -1, 1), (1, 1, 4), (count, 3))
    points[:, :2] *= 0.4 * points[:, 2:]
    return project(CAMERA, points), transform(T_WORLD_CAMERA, points), points[:, 2]


def test_absolute_pose_from_exact_matches_is_exact() -> None:
    """An offset of half a pixel would rotate the camera by a milliradian."""
    pixels, points_world, depth = matches(100)
    found = AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world, depth)
    assert found is not None
    assert found.inliers.sum() == 100
    np.testing.assert_allclose(found.T_world_camera, T_WORLD_CAMERA, atol=1e-6)


def test_absolute_pose_rejects_outliers() -> None:
    rng = np.random.default_rng(1)
    pixels, points_world, _ = matches(200)
    pixels += rng.normal(0, 0.5, pixels.shape)
    pixels[:120] = rng.uniform((0, 0), (640, 480), (120, 2))
    first = AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world)
    assert first is not None
    assert first.inliers[120:].mean() > 0.98
    assert first.inliers[:120].mean() < 0.02
    error = inverse(T_WORLD_CAMERA) @ first.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.005
    assert rotation_angle(error[:3, :3]) < 0.002


@pytest.mark.parametrize("factor", [1, 3])
def test_absolute_pose_error_limit_scales_with_resolution(factor: int) -> None:
    """If the image is enlarged by a factor, the pixel errors increase by this factor."""
    pixels, points_world, _ = matches(100)
    camera = Camera(
        factor * CAMERA.width, factor * CAMERA.height, factor * CAMERA.fx, factor * CAMERA.fy,
        factor * (CAMERA.cx + 0.5) - 0.5, factor * (CAMERA.cy + 0.5) - 0.5,
    )  # fmt: skip
    angles = np.linspace(0, 20 * np.pi, 100)
    pixels += 1.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = AbsolutePoseEstimator().estimate(camera, factor * (pixels + 0.5) - 0.5, points_world)
    assert found is not None
    assert found.inliers.sum() > 95


def test_absolute_pose_is_deterministic_for_given_seed() -> None:
    """The matches are so noisy that the inliers depend on the random samples."""
    rng = np.random.default_rng(2)
    pixels, points_world, _ = matches(120)
    pixels += rng.normal(0, 4, pixels.shape)
    estimator = AbsolutePoseEstimator(seed=3)
    first = estimator.estimate(CAMERA, pixels, points_world)
    assert first is not None
    for k in range(4):
        estimator.estimate(CAMERA, *matches(50, seed=k)[:2])
        again = AbsolutePoseEstimator(seed=3).estimate(CAMERA, pixels, points_world)
        assert again is not None
        np.testing.assert_array_equal(again.T_world_camera, first.T_world_camera)
    others = [AbsolutePoseEstimator(seed=k).estimate(CAMERA, pixels, points_world) for k in range(4, 10)]
    assert any(other is None or not np.array_equal(other.inliers, first.inliers) for other in others)


@pytest.mark.parametrize("count", [0, 3, 4, 30, 300])
def test_absolute_pose_of_random_matches_is_none(count: int) -> None:
    rng = np.random.default_rng(count)
    pixels, points_world = rng.uniform((0, 0), (640, 480), (count, 2)), rng.uniform(-2, 2, (count, 3))
    assert AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world) is None


def test_absolute_pose_with_too_few_inliers_is_none() -> None:
    pixels, points_world, _ = matches(100)
    assert AbsolutePoseEstimator(min_inliers=101).estimate(CAMERA, pixels, points_world) is None
    pixels[:60] = np.random.default_rng(0).uniform((0, 0), (640, 480), (60, 2))
    assert AbsolutePoseEstimator(min_inlier_ratio=0.3).estimate(CAMERA, pixels, points_world) is not None
    assert AbsolutePoseEstimator(min_inlier_ratio=0.5).estimate(CAMERA, pixels, points_world) is None


def test_absolute_pose_ignores_non_finite_matches() -> None:
    pixels, points_world, depth = matches(100)
    pixels[:10], points_world[10:20], points_world[20:30] = np.nan, np.nan, np.inf
    found = AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world, depth)
    assert found is not None
    assert found.inliers.tolist() == [False] * 30 + [True] * 70
    assert AbsolutePoseEstimator().estimate(CAMERA, pixels * np.nan, points_world) is None


def test_absolute_pose_rejects_matches_with_inconsistent_depth() -> None:
    pixels, points_world, depth = matches(100)
    depth[:30] *= 1.2
    depth[30:50] = 0  # missing depth does not affect matches
    found = AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world, depth)
    assert found is not None
    assert found.inliers.tolist() == [False] * 30 + [True] * 70
    assert AbsolutePoseEstimator().estimate(CAMERA, pixels, points_world, 2 * depth[::-1]) is None


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (0.01, 0.02, 0.01)], ids=["point", "line"])
def test_absolute_pose_of_degenerate_points_is_unknown(direction: tuple[float, float, float]) -> None:
    points = np.array([0.1, 0.2, 2.0]) + np.outer(np.arange(50), direction)
    pixels = project(CAMERA, points)
    assert AbsolutePoseEstimator().estimate(CAMERA, pixels, points) is None


@pytest.mark.parametrize("bound", [{"max_error": 0.0}, {"min_inliers": 3}, {"min_inlier_ratio": 1.5}, {"seed": -1}])
def test_absolute_pose_parameter_out_of_range_raises(bound: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=rf"AbsolutePoseEstimator\.{next(iter(bound))}"):
        AbsolutePoseEstimator(**bound)
