"""Tests for the depth scale, by which limits increase with depth."""

from __future__ import annotations

import numpy as np
import pytest

from framework.geometry import exp_se3
from framework.tracking.depth_scale import DepthScale


@pytest.mark.parametrize(("depth", "growth"), [(0.5, 1.0), (5.0, 1.0), (10.0, 2.0), (50.0, 10.0)])
def test_depth_scale_grows_beyond_range(depth: float, growth: float) -> None:
    assert DepthScale(depth).growth == pytest.approx(growth)


def test_depth_scale_is_median_of_readings() -> None:
    assert DepthScale.of(np.array([[0, 2, 3], [0, 8, 0]], np.float32)).depth == 3
    assert DepthScale.of(np.zeros((2, 3), np.float32)).growth == 1, "expected no growth without depth"


def test_depth_scale_divides_translation_by_growth() -> None:
    T = exp_se3(np.array([0.4, 0, 0, 0, 0, 0]))
    assert DepthScale(20.0).distance(np.eye(4), T) == pytest.approx(0.1)
    assert DepthScale(20.0).near(T, np.eye(4), 0.11)
    assert not DepthScale(2.0).near(T, np.eye(4), 0.11)
    turn = exp_se3(np.array([0, 0, 0, 0, 0.2, 0]))
    assert DepthScale(20.0).distance(turn, np.eye(4)) == pytest.approx(0.2)
    assert DepthScale(20.0).length(np.array([0.4, 0, 0, 0, -0.2, 0])) == pytest.approx(0.2)


def test_information_without_units_is_scale_invariant() -> None:
    """The derivatives of a pixel with respect to translation are proportional to the inverse depth."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(20, 6))
    far = np.concatenate([J[:, :3] / 7, J[:, 3:]], axis=1)
    np.testing.assert_allclose(DepthScale(14.0).without_units(far.T @ far), DepthScale(2.0).without_units(J.T @ J))
