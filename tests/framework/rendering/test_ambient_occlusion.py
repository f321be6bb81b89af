"""Tests for ambient occlusion on planes."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.rendering.ambient_occlusion import DEPTH, RANGE_M, openness
from framework.rendering.ambient_occlusion_kernels import THICKNESS_M, TILE

CAMERA = Camera(160, 120, 300.0, 310.0, 79.5, 59.5)
X, Y = np.meshgrid(
    (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx, (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
)
RAYS = np.stack([X, Y, np.ones_like(X)], axis=-1)


def plane(normal: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth (H, W), m, and the normals (H, W, 3) of the plane normal @ p = -distance."""
    return np.float32(-distance / (RAYS @ normal)), np.tile(normal.astype(np.float32), (*CAMERA.shape, 1))


@pytest.mark.parametrize("angle", [0.0, 0.6, -0.9])
def test_openness_of_plane_is_one(angle: float) -> None:
    depth, normals = plane(np.array([0.2, np.sin(angle), -np.cos(angle)]) / np.hypot(1, 0.2), 1.5)
    assert (depth > 0).all()
    np.testing.assert_array_equal(openness(CAMERA, depth, normals), 1)


def test_openness_in_corner_matches_ray_casting() -> None:
    """Two planes meet at a right angle 2 m in front of the camera."""
    depth = np.float32(2 / (1 + np.abs(Y)))
    normals = np.stack([np.zeros_like(Y), -np.sign(Y), -np.ones_like(Y)], axis=-1).astype(np.float32) / np.sqrt(2)
    found = openness(CAMERA, depth, normals)
    rng = np.random.default_rng(0)
    height, turn = np.sqrt(rng.uniform(0, 1, 20000)), rng.uniform(0, 2 * np.pi, 20000)  # cosine-weighted directions
    towards = np.sqrt(1 - height**2) * np.cos(turn)  # component of the direction toward the other plane
    for row in range(TILE, CAMERA.height - TILE, 7):
        distance = np.abs(Y[row, 0]) * depth[row, 0] * np.sqrt(2)  # m, distance from the edge
        blocked = (distance < RANGE_M * towards).mean()
        assert found[row, TILE:-TILE].mean() == pytest.approx(1 - DEPTH * blocked, abs=0.03)
    assert found.min() < 0.75
    np.testing.assert_array_equal(found, openness(CAMERA, depth, normals))


@pytest.mark.parametrize(("gap", "darkens"), [(0.6 * THICKNESS_M, True), (2 * RANGE_M, False)])
def test_openness_pole_darkens_only_near_background(gap: float, darkens: bool) -> None:
    depth, normals = plane(np.array([0, 0, -1.0]), 3.0)
    pole = np.abs(X) < 0.02
    depth = np.where(pole, np.float32(3 - gap), depth)
    assert (openness(CAMERA, depth, normals)[~pole].min() < 0.9) == darkens
    assert (openness(CAMERA, depth, normals)[:, TILE + 1 : 40] == 1).all()


def test_openness_around_missing_depth_is_one() -> None:
    depth, normals = plane(np.array([0, 0, -1.0]), 3.0)
    depth[40:80, 50:90] = 0
    np.testing.assert_array_equal(openness(CAMERA, depth, normals), 1)
