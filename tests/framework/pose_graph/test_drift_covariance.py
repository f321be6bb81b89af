"""Tests for the covariance of drift."""

from __future__ import annotations

import numpy as np
import pytest

from framework.geometry import exp_se3, inverse
from framework.pose_graph.drift_covariance import GROWTH, LEAST, UNKNOWN, DriftCovariance
from framework.pose_graph.submap_anchors import view_separation

FLOOR = np.diag(np.repeat(LEAST, 3) ** 2)
STEP = exp_se3(np.array([0.05, 0.0, 0.1, 0.02, -0.03, 0.01]))  # motion between two frames
C = np.diag([4e-8, 1e-8, 9e-8, 1e-8, 4e-8, 2e-8])  # covariance of each pose


def moved(steps: int, step: np.ndarray, covariance: np.ndarray | None) -> DriftCovariance:
    """Return the drift after equal steps."""
    drift, T = DriftCovariance(), np.eye(4)
    drift.enter(T)
    for _ in range(steps):
        T = T @ step
        drift.move(T, covariance)
    return drift


def test_drift_covariance_agrees_with_simulated_paths() -> None:
    """Reference: paths whose steps have random errors."""
    rng, steps, T_camera_anchor = np.random.default_rng(0), 20, exp_se3(np.array([0.3, -0.1, 0.2, 0.0, 0.5, 0.1]))
    separation = view_separation(np.eye(4)[None], STEP)[0]
    true = np.linalg.matrix_power(STEP, steps) @ T_camera_anchor
    twists = []
    for _ in range(4000):
        T = np.eye(4)
        for xi in rng.standard_normal((steps, 6)) * np.sqrt(separation * GROWTH * np.diag(C)):
            T = T @ STEP @ exp_se3(xi)
        error = inverse(true) @ T @ T_camera_anchor
        twists.append([*error[:3, 3], error[2, 1], error[0, 2], error[1, 0]])
    expected = moved(steps, STEP, C).at(T_camera_anchor) - FLOOR
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((np.cov(np.array(twists).T) - expected) / scale).max() < 0.1


def test_drift_covariance_does_not_depend_on_frame_rate() -> None:
    forward = exp_se3(np.array([0, 0, 0.1, 0, 0, 0]))
    half = exp_se3(np.array([0, 0, 0.05, 0, 0, 0]))
    slow, fast = (moved(*args, np.diag([1e-8] * 3 + [0.0] * 3)).at(np.eye(4)) for args in ((20, forward), (40, half)))
    assert slow == pytest.approx(fast)


def test_drift_covariance_stationary_camera_does_not_drift() -> None:
    assert moved(100, np.eye(4), C).at(np.eye(4)) == pytest.approx(FLOOR)


def test_drift_covariance_unknown_covariance_is_replaced() -> None:
    """One new view, 0.5 m ahead."""
    drift = moved(1, exp_se3(np.array([0, 0, 0.5, 0, 0, 0])), None)
    assert drift.at(np.eye(4)) == pytest.approx(np.diag(np.repeat(UNKNOWN, 3) ** 2) + FLOOR)


def test_drift_covariance_begins_again_in_each_submap() -> None:
    drift = moved(20, STEP, C)
    drift.enter(np.eye(4))
    assert drift.at(np.eye(4)) == pytest.approx(FLOOR)
