"""Tests for the registration of surfaces, with exact geometry."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.editing.keyframe_registration import PointMatches
from framework.editing.surface_registration import registered
from framework.geometry import exp_se3, inverse, pose_distance, transform
from framework.rendering.surface import Surface

T_A_B = exp_se3(np.array([0.8, -0.3, 0.5, 0.2, 0.4, -0.3]))


def height(x: Float64, y: Float64, bumps: float) -> Float64:
    return np.asarray(bumps * (np.sin(3 * x) * np.cos(2 * y) + 0.5 * np.cos(5 * y)))


def surface(low: float, high: float, step: float, bumps: float, T_other_world: Float64) -> Surface:
    """Return the surface z = height(x, y) over x in [low, high] and y in [0, 2] in the world frame `other`."""
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(0, 2, step), indexing="ij")
    vertices = np.stack([x, y, height(x, y, bumps)], axis=-1).reshape(-1, 3)
    index = np.arange(len(vertices), dtype=np.int32).reshape(x.shape)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    a, b, c, d = (corner.ravel() for corner in corners)
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(transform(T_other_world, vertices).astype(np.float32), triangles)


def features(T_a_b: Float64, count: int, noise: float, bumps: float = 0.0) -> PointMatches:
    """Return matched points of both surfaces."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(1.5, 3.0, count), rng.uniform(0, 2, count)
    points = np.stack([x, y, height(x, y, bumps)], axis=1)
    return PointMatches(points + rng.normal(0, noise, points.shape), transform(inverse(T_a_b), points), [0, count])


def test_registered_surfaces_with_partial_overlap_agree() -> None:
    a = surface(0.0, 3.0, 0.02, 0.2, np.eye(4))
    b = surface(1.5, 4.0, 0.023, 0.2, inverse(T_A_B))
    initial = exp_se3(np.array([0.04, -0.03, 0.05, 0.02, -0.01, 0.02])) @ T_A_B
    found = registered(a, b, initial, features(T_A_B, 12, 0.02, bumps=0.2))
    assert pose_distance(found, T_A_B) < 0.1 * pose_distance(initial, T_A_B)


def test_registered_planes_keep_directions_of_features() -> None:
    a, b = surface(0.0, 3.0, 0.02, 0.0, np.eye(4)), surface(1.5, 4.0, 0.023, 0.0, inverse(T_A_B))
    initial = exp_se3(np.array([0.03, 0.03, 0.04, 0, 0, 0.01])) @ T_A_B
    found = registered(a, b, initial, features(T_A_B, 200, 0.0))
    assert pose_distance(found, T_A_B) < 1e-3
