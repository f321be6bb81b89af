"""Tests for rigid motions and the pinhole camera, compared with their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from framework import geometry
from framework.data import Camera
from framework.errors import DataError

twists = arrays(np.float64, 6, elements=st.floats(-3, 3, width=32))
CAMERA = Camera(64, 48, 50.0, 52.0, 30.5, 24.25)


def hat(xi: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = geometry.skew(xi[3:]), xi[:3]
    return matrix


@given(twists)
def test_exp_se3_equals_matrix_exponential(xi: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.exp_se3(xi), expm(hat(xi)), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-8, 3e-8, 1e-7, 1e-6, 1e-5, 1e-4, np.pi - 1e-7, np.pi])
def test_exp_se3_is_exact_at_small_and_large_angles(angle: float) -> None:
    xi = np.array([1.0, -2.0, 0.5, 0.6 * angle, 0.0, -0.8 * angle])
    np.testing.assert_allclose(geometry.exp_se3(xi), expm(hat(xi)), rtol=0, atol=1e-14 + 1e-15 * angle)


@given(twists)
def test_inverse_times_transform_is_identity(xi: np.ndarray) -> None:
    T = geometry.exp_se3(xi)
    np.testing.assert_allclose(geometry.inverse(T) @ T, np.eye(4), atol=1e-12)


@given(twists, arrays(np.float64, (5, 3), elements=st.floats(-10, 10, width=32)))
def test_transform_equals_homogeneous_product(xi: np.ndarray, points: np.ndarray) -> None:
    T = geometry.exp_se3(xi)
    expected = (np.c_[points, np.ones(5)] @ T.T)[:, :3]
    np.testing.assert_allclose(geometry.transform(T, points), expected, atol=1e-11)
    assert geometry.transform(T, points.astype(np.float32)).dtype == np.float32


def test_skew_equals_cross_product() -> None:
    v, w = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    np.testing.assert_allclose(geometry.skew(v) @ w, np.cross(v, w))


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-6, 0.3, 3.0, np.pi])
def test_rotation_angle_matches_rotation_vector(angle: float) -> None:
    R = Rotation.from_rotvec(angle * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()
    assert geometry.rotation_angle(R) == pytest.approx(angle, rel=1e-9, abs=1e-15)


@given(arrays(np.float64, (3, 3), elements=st.floats(-1, 1, width=32)))
def test_nearest_rotation_minimizes_distance(noise: np.ndarray) -> None:
    M = np.eye(3) + 0.3 * noise
    R = geometry.nearest_rotation(M)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    for axis in np.eye(3):
        for angle in (-1e-3, 1e-3):
            other = R @ Rotation.from_rotvec(angle * axis).as_matrix()
            assert np.linalg.norm(M - R) <= np.linalg.norm(M - other) + 1e-12


def test_nearest_rotation_of_reflection_is_rotation() -> None:
    assert np.linalg.det(geometry.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)


def test_project_inverts_back_project_at_every_pixel() -> None:
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    pixels = np.stack([u.ravel(), v.ravel()], 1).astype(np.int32)
    depth = np.linspace(0.5, 4, len(pixels), dtype=np.float32)
    points = geometry.back_project(CAMERA, pixels, depth)
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[:, 2], depth)
    np.testing.assert_allclose(geometry.project(CAMERA, points), pixels, atol=1e-4)


def test_back_project_principal_point_lies_on_optical_axis() -> None:
    camera = Camera(3, 3, 10.0, 10.0, 1.0, 1.0)
    center = geometry.back_project(camera, np.array([[1, 1]], np.int32), np.array([2.0], np.float32))
    np.testing.assert_array_equal(center, [[0, 0, 2]])


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
def test_scaled_camera_keeps_rays(factor: float) -> None:
    """If the size is halved, pixel k corresponds to the pixels 2k and 2k + 1."""
    scaled = CAMERA.scaled(factor)
    point = np.array([[0.3, -0.2, 1.5]])
    full, resized = geometry.project(CAMERA, point) + 0.5, geometry.project(scaled, point) + 0.5
    np.testing.assert_allclose(resized, full * factor)


@given(twists, arrays(np.float64, (3, 3), elements=st.floats(-1, 1, width=32)))
def test_nearest_rigid_removes_rounding_of_pose(xi: np.ndarray, noise: np.ndarray) -> None:
    T = geometry.exp_se3(xi)
    rounded = T.copy()
    rounded[:3, :3] += 1e-4 * noise
    repaired = geometry.nearest_rigid(rounded)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(repaired, T, atol=1e-3)
    np.testing.assert_array_equal(repaired[:, 3], T[:, 3])


def test_nearest_rigid_keeps_exact_pose_unchanged() -> None:
    T = geometry.exp_se3(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 0.6]))
    np.testing.assert_array_equal(geometry.nearest_rigid(T), T)


@pytest.mark.parametrize(
    ("matrix", "why"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "det R = -1"),
        (np.diag([1.0, 1.01, 1.0, 1.0]), "expected a rigid transform"),
        (np.zeros((4, 4)), "last row"),
        (np.diag([1.0, 1.0, 1.0, -1.0]), "last row"),
        (np.full((4, 4), np.inf), "expected finite values"),
        (
            np.array([[1e200, -1e200, 0, 0], [1e200, 1e200, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
            "expected a rigid transform",
        ),
    ],
)
def test_nearest_rigid_non_rigid_matrix_raises(matrix: np.ndarray, why: str) -> None:
    with pytest.raises(DataError, match=why):
        geometry.nearest_rigid(matrix)


@given(twists, twists)
def test_interpolate_is_linear_between_poses(xi_a: np.ndarray, xi_b: np.ndarray) -> None:
    T_a, T_b = geometry.exp_se3(xi_a), geometry.exp_se3(xi_b)
    np.testing.assert_allclose(geometry.interpolate(T_a, T_b, 0), T_a, atol=1e-12)
    np.testing.assert_allclose(geometry.interpolate(T_a, T_b, 1), T_b, atol=1e-7)  # half turns are ill-conditioned
    third = geometry.interpolate(T_a, T_b, 1 / 3)
    np.testing.assert_allclose(third[:3, 3], T_a[:3, 3] + (T_b - T_a)[:3, 3] / 3, atol=1e-12)
    whole = geometry.rotation_angle(T_a[:3, :3].T @ T_b[:3, :3])
    assert geometry.rotation_angle(T_a[:3, :3].T @ third[:3, :3]) == pytest.approx(whole / 3, abs=1e-7)


def test_adjoint_transforms_twist_to_other_frame() -> None:
    T, xi = geometry.exp_se3(np.array([0.3, -0.2, 0.1, 0.4, -0.5, 0.2])), np.array([0.02, 0.01, -0.03, 0.1, 0.05, -0.2])
    np.testing.assert_allclose(T @ geometry.exp_se3(xi), geometry.exp_se3(geometry.adjoint(T) @ xi) @ T, atol=1e-14)
