"""Tests for pose covariances that are computed from normal equations."""

from __future__ import annotations

import numpy as np
import pytest

from framework.geometry import adjoint, exp_se3, inverse
from framework.tracking.alignment import NormalEquations
from framework.tracking.uncertainty import CORRELATED, is_significant, pose_covariance


def equations(
    J: np.ndarray, r: np.ndarray, J_color: np.ndarray | None = None, r_color: np.ndarray | None = None
) -> NormalEquations:
    """Return the equations with unit weights for Jacobians (n, 6) and residuals (n,)."""
    J_color = np.zeros((0, 6)) if J_color is None else J_color
    r_color = np.zeros(0) if r_color is None else r_color
    A_color = J_color.T @ J_color
    return NormalEquations(
        J.T @ J + A_color, np.zeros(6), len(r), len(r), len(r), 0,
        A_color, float(r @ r), float(r_color @ r_color), len(r_color), 0.0,
    )  # fmt: skip


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_covariance_depends_on_residuals_not_assumed_noise(noise: float) -> None:
    J = np.random.default_rng(0).normal(size=(40, 6))
    C = pose_covariance([equations(J, np.full(40, noise))], np.eye(4))
    np.testing.assert_allclose(C, CORRELATED * noise**2 * np.linalg.inv(J.T @ J))


def test_covariance_of_terms_matches_simulated_estimates() -> None:
    """The actual noise is 3 times the assumed noise for color, and half of it for depth."""
    rng = np.random.default_rng(1)
    J, J_color = rng.normal(size=(60, 6)), rng.normal(size=(60, 6))
    both = np.concatenate([J, J_color])
    noise = rng.normal(size=(20_000, 120)) * np.repeat([0.5, 3.0], 60)
    estimates = noise @ both @ np.linalg.inv(both.T @ both)
    found = pose_covariance([equations(J, np.full(60, 0.5), J_color, np.full(60, 3.0))], np.eye(4)) / CORRELATED
    scale = np.sqrt(np.diag(found))
    np.testing.assert_allclose(np.cov(estimates.T) / np.outer(scale, scale), found / np.outer(scale, scale), atol=0.03)


def test_covariance_is_in_camera_frame() -> None:
    """A twist in the view frame is transformed to the camera frame by the adjoint of T_camera_view."""
    J = np.random.default_rng(2).normal(size=(40, 6))
    T_view_camera = exp_se3(np.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.3]))
    Ad = adjoint(inverse(T_view_camera))
    term = [equations(J, np.ones(40))]
    np.testing.assert_allclose(
        pose_covariance(term, T_view_camera), Ad @ pose_covariance(term, np.eye(4)) @ Ad.T, rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("axis", range(6))
def test_motion_is_significant_beyond_its_uncertainty(axis: int) -> None:
    C = np.diag(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]) * 1e-3) ** 2
    for factor, expected in ((2.4, False), (2.5, True)):  # the limit is sqrt(6) = 2.45
        xi = np.zeros(6)
        xi[axis] = -factor * np.sqrt(C[axis, axis])
        assert is_significant(exp_se3(xi), C) == expected


def test_motion_without_uncertainty_is_significant() -> None:
    assert is_significant(exp_se3(np.array([1e-6, 0, 0, 0, 0, 0])), np.zeros((6, 6)))
    assert not is_significant(np.eye(4), np.zeros((6, 6)))
