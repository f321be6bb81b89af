"""Tests for shaded views in surface colors and in instance colors."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.rendering.lit_view import NOTHING, LitView
from framework.rendering.lit_view_kernels import AMBIENT, DIFFUSE, LAMP
from framework.rendering.surface import Surface

CAMERA = Camera(40, 20, 20.0, 20.0, 19.5, 9.5)
LIGHT = AMBIENT - DIFFUSE * LAMP[2] / np.linalg.norm(LAMP)  # shading of a surface that faces the camera


def quad(left: float, right: float) -> np.ndarray:
    """Return the corners (4, 3), m, of a rectangle 1 m in front of the camera.

    The rectangle is taller than the image.
    """
    return np.array([[left, -2, 1], [left, 2, 1], [right, 2, 1], [right, -2, 1]], np.float32)


@pytest.fixture(scope="module")
def view() -> LitView:
    """Return a view of two rectangles. Each is 10 columns wide, and the 10 columns on each side are empty."""
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    return LitView(Surface(np.concatenate([quad(-0.5, 0), quad(0, 0.5)]), triangles), CAMERA, np.eye(4))


COLORS = np.repeat([[90, 120, 150], [200, 100, 0]], 4, axis=0).astype(np.uint8)


def test_lit_view_in_colors_is_shaded_on_plain_background(view: LitView) -> None:
    image = view.in_colors(COLORS)
    assert image.dtype == np.uint8
    assert image.shape == (20, 40, 3)
    np.testing.assert_array_equal(image[:, :10], np.broadcast_to(np.uint8(NOTHING), (20, 10, 3)))
    np.testing.assert_array_equal(image[:, 30:], np.broadcast_to(np.uint8(NOTHING), (20, 10, 3)))
    np.testing.assert_allclose(image[:, 11:19].astype(float), np.tile(COLORS[0] * 1.08 * LIGHT, (20, 8, 1)), atol=1)
    np.testing.assert_allclose(image[:, 21:29].astype(float), np.tile(COLORS[4] * 1.08 * LIGHT, (20, 8, 1)), atol=1)


def test_lit_view_in_instances_has_colors_and_dark_borders(view: LitView) -> None:
    ids = np.repeat([1, 0], 4).astype(np.int32)
    image = view.in_instances(COLORS, ids, {1: np.array([10, 200, 90], np.uint8)}).astype(float)
    painted = np.array([10, 200, 90]) * (0.84 + 0.16 * 120 / 140) * LIGHT
    pale = (178 + 0.22 * 100) * LIGHT
    np.testing.assert_allclose(image[:, 11:19], np.tile(painted, (20, 8, 1)), atol=1)
    np.testing.assert_allclose(image[:, 21:29], pale, atol=1)
    # at a border, one of two supersampled columns is dark
    np.testing.assert_allclose(image[:, 19], np.tile(painted * (1 + 0.45) / 2, (20, 1)), atol=1)
    np.testing.assert_allclose(image[:, 20], pale * (1 + 0.45) / 2, atol=1)
    np.testing.assert_allclose(image[:, 10], np.tile(painted * (1 + 0.45) / 2, (20, 1)), atol=1)
    np.testing.assert_allclose(image[:, 29], pale, atol=1)  # parts without an instance have no border


def test_lit_view_is_invariant_to_world_rotation() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-0.4, 0.4, (60, 3)).astype(np.float32) + np.float32([0, 0, 1.2])
    triangles = rng.integers(0, 60, (40, 3), np.int32)
    colors = rng.integers(0, 256, (60, 3)).astype(np.uint8)
    turned = np.eye(4)
    turned[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # an exact rotation
    here = LitView(Surface(vertices, triangles), CAMERA, np.eye(4))
    there = LitView(Surface(vertices @ turned[:3, :3].T.astype(np.float32), triangles), CAMERA, turned)
    assert 0.1 < here.hits.seen.mean() < 0.9
    differences = np.abs(here.in_colors(colors).astype(int) - there.in_colors(colors))
    assert (differences > 1).mean() < 0.01
