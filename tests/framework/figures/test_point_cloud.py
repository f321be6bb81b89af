"""Points as discs in a depth buffer."""

from __future__ import annotations

import numpy as np
import pytest

from framework.figures.point_cloud import orthographic, shading, splat
from framework.rendering.viewpoint import looking


def f32(values: object) -> np.ndarray:
    return np.array(values, np.float32)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_the_nearest_point_shows(order: list[int]) -> None:
    pixels, depth = f32([[3, 2], [3, 2], [5, 2]])[order], f32([4, -1, 2])[order]
    nearest, buffer = splat(pixels, depth, f32([0, 0, 0]), (6, 8))
    assert nearest[2, 3] == order.index(1)
    assert nearest[2, 5] == order.index(2)
    assert (nearest >= 0).sum() == 2
    assert buffer[2, 3] == -1
    assert np.isinf(buffer[0, 0])


def test_a_point_is_a_disc_cut_at_the_border() -> None:
    nearest, _ = splat(f32([[4, 4], [0, 0]]), f32([1, 1]), f32([2, 1]), (9, 9))
    y, x = np.mgrid[:9, :9]
    expected = np.where((x - 4) ** 2 + (y - 4) ** 2 <= 4, 0, np.where(x**2 + y**2 <= 1, 1, -1))
    np.testing.assert_array_equal(nearest, expected)


def test_what_is_outside_or_not_a_number_is_left_out() -> None:
    outside = f32([[-5, 1], [1, -5], [20, 1], [1, 20], [np.nan, 1], [1e12, 1]])
    nearest, _ = splat(outside, np.zeros(6, np.float32), np.ones(6, np.float32), (8, 8))
    assert (nearest == -1).all()
    of_none, _ = splat(outside[:0], f32([]), f32([]), (8, 8))
    assert (of_none == -1).all()


def test_the_first_of_equally_near_points_shows() -> None:
    nearest, _ = splat(f32([[1, 1], [1, 1]]), f32([2, 2]), f32([0, 0]), (3, 3))
    assert nearest[1, 1] == 0


def test_only_what_lies_behind_its_neighbors_is_dark() -> None:
    buffer = np.full((20, 20), np.inf, np.float32)
    buffer[:, :10] = 1.0
    buffer[:, 10:18] = 2.0
    lit = shading(buffer)
    np.testing.assert_array_equal(lit[:, :10], 1)
    np.testing.assert_array_equal(lit[:, 14:], 1)
    assert (np.diff(lit[5, 9:15]) >= 0)[1:].all()
    assert lit[5, 10] < 0.7


def test_the_view_is_to_scale_and_centered() -> None:
    points = f32([[0, 0, 5], [2, 0, 6], [0, 1, 7], [2, 1, 8]])
    pixels, depth, scale = orthographic(points, np.eye(3), np.repeat(points, 500, axis=0), (100, 200), 0.1, 0.1)
    assert scale == pytest.approx(80)  # 80 % of 200 px for 2 m, of 100 px for 1 m
    np.testing.assert_allclose(pixels, [[19.5, 9.5], [179.5, 9.5], [19.5, 89.5], [179.5, 89.5]], atol=1e-3)
    np.testing.assert_array_equal(depth, [5, 6, 7, 8])


def test_the_view_turns_and_leaves_strays_out() -> None:
    R = looking(np.array([1.0, 0, 0]), np.array([0.0, 0, 1]))  # along x, z upwards: y to the left
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (10000, 3)).astype(np.float32)
    stray = f32([[0, 40, 0]])
    pixels, depth, scale = orthographic(cloud, R, np.concatenate([cloud, stray]), (100, 100), 0.0, 0.1)
    assert scale == pytest.approx(100, rel=0.03)
    np.testing.assert_array_equal(depth, cloud[:, 0])
    np.testing.assert_allclose(np.diff(pixels[:2, 0]), -np.diff(cloud[:2, 1]) * scale, rtol=1e-4)
    np.testing.assert_allclose(np.diff(pixels[:2, 1]), -np.diff(cloud[:2, 2]) * scale, rtol=1e-4)


def test_a_single_point_is_not_enlarged_without_end() -> None:
    _, _, scale = orthographic(f32([[1, 2, 3]]), np.eye(3), f32([[1, 2, 3]]), (100, 200), 0.0, 0.5)
    assert scale == pytest.approx(200)
