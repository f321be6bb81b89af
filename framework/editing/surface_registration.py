"""Registration of two overlapping surfaces by point-to-plane ICP (Chen and Medioni, 1992).

Matched feature points keep the directions in place that the surfaces do not determine, such as motion along a wall.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from framework.data import Float64
from framework.editing.keyframe_registration import PointMatches
from framework.geometry import exp_se3, nearest_rotation, transform
from framework.rendering.surface import Surface

SAMPLES = 20_000  # approximate number of sampled vertices
RADII = (0.15, 0.1, 0.05)  # m, maximum distance of corresponding points, from coarse to fine
ITERATIONS = 15  # maximum number of iterations for each distance
MIN_NORMAL_DOT = 0.7  # minimum scalar product of the normals of corresponding points
PLANE_SIGMA, FEATURE_SIGMA = 0.01, 0.03  # m, standard deviations of distances to planes and of feature points
CONVERGED = 1e-5  # m and rad, maximum last step


def registered(a: Surface, b: Surface, T_a_b: Float64, matches: PointMatches) -> Float64:
    """Return a refined transform T_a_b (4, 4).

    Args:
        a: The first surface.
        b: The second surface.
        T_a_b: The initial transform (4, 4).
        matches: Matched feature points.
    """
    tree = KDTree(a.vertices)
    chosen = slice(None, None, max(1, len(b.vertices) // SAMPLES))
    points_b, normals_b = b.vertices[chosen].astype(np.float64), b.vertex_normals[chosen].astype(np.float64)
    for radius in RADII:
        for _ in range(ITERATIONS):
            points, normals = transform(T_a_b, points_b), normals_b @ T_a_b[:3, :3].T
            distance, nearest = map(np.asarray, tree.query(points, distance_upper_bound=radius))
            near = np.flatnonzero(np.isfinite(distance))
            near = near[(a.vertex_normals[nearest[near]] * normals[near]).sum(axis=1) >= MIN_NORMAL_DOT]
            plane = a.vertex_normals[nearest[near]].astype(np.float64)
            residuals = ((a.vertices[nearest[near]] - points[near]) * plane).sum(axis=1)
            xi = _step(points[near], plane, residuals, radius, T_a_b, matches)
            T_a_b = exp_se3(xi) @ T_a_b
            T_a_b[:3, :3] = nearest_rotation(T_a_b[:3, :3])
            if np.abs(xi).max() < CONVERGED:
                break
    return T_a_b


def _step(
    points: Float64, normals: Float64, residuals: Float64, radius: float, T_a_b: Float64, matches: PointMatches
) -> Float64:
    """Return the twist (6,) of a Gauss-Newton step.

    Args:
        points: The moved points (N, 3), m.
        normals: The normals (N, 3) at the corresponding points.
        residuals: The distances (N,) along the normals, m.
        radius: The maximum distance of corresponding points, m.
        T_a_b: The current transform (4, 4).
        matches: Matched feature points.
    """
    center = points.mean(axis=0) if len(points) else np.zeros(3)  # the normal matrix is better conditioned
    weights = (1 - np.clip(residuals / radius, -1, 1) ** 2) ** 2 / PLANE_SIGMA**2  # Tukey's biweight
    J = np.concatenate([normals, np.cross(points - center, normals)], axis=1)
    H, g = J.T @ (weights[:, None] * J), J.T @ (weights * residuals)
    features = transform(T_a_b, matches.points_b)
    errors = matches.points_a - features
    for axis in np.eye(3):
        J = np.concatenate([np.broadcast_to(axis, features.shape), np.cross(features - center, axis)], axis=1)
        H += J.T @ J / FEATURE_SIGMA**2
        g += J.T @ (errors @ axis) / FEATURE_SIGMA**2
    xi: Float64 = np.linalg.lstsq(H, g)[0]  # 0 in directions that nothing determines
    xi[:3] -= np.cross(xi[3:], center)  # rotation about the origin
    return xi
