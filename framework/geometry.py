"""Rigid transforms and camera projection.

The conventions are described in `framework.data`.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from framework.data import Camera, Float32, Float64, Int32, PointClusters, UInt8
from framework.errors import DataError, errors_of

RIGID_WITHIN = 1e-2  # maximum entry of |R R^T - I| due to rounding in files; larger for lost poses, stored as R = 0
FARTHEST = 1e4  # m, maximum distance of a pose from the origin; at this distance, float32 resolves 1 mm
MAX_SKEW = 1e-3  # px, maximum skew of a camera matrix, and maximum error of its other constant entries
EXACT_WITHIN = 1e-12  # maximum entry of |R R^T - I| of a float64 rotation, which is not changed


def inverse(T_a_b: Float64) -> Float64:
    """Return the inverse of a rigid transform.

    Args:
        T_a_b: The transform (4, 4).

    Returns:
        The transform T_b_a (4, 4).
    """
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def transform(T_a_b: Float64, points_b: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Transform points from frame b to frame a.

    Args:
        T_a_b: The rigid transform (4, 4).
        points_b: The points (..., 3) in frame b, m.

    Returns:
        The points (..., 3) in frame a, m, with the same dtype.
    """
    moved = points_b @ T_a_b[:3, :3].T.astype(points_b.dtype) + T_a_b[:3, 3].astype(points_b.dtype)
    return np.asarray(moved, points_b.dtype)


def skew(v: Float64) -> Float64:
    """Return the skew-symmetric matrix S (3, 3) of a vector v (3,).

    The product S @ w is the cross product of v and w.
    """
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(T: Float64) -> Float64:
    """Return the adjoint matrix (6, 6) of a rigid transform T (4, 4).

    The adjoint Ad satisfies T exp(xi) = exp(Ad xi) T. A twist xi (6,) consists of translation, m, and rotation, rad.
    """
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = T[:3, :3]
    Ad[:3, 3:] = skew(T[:3, 3]) @ T[:3, :3]
    return Ad


def exp_se3(xi: Float64) -> Float64:
    """Return the rigid transform of a twist, i.e. the exponential map of SE(3).

    Args:
        xi: The twist (6,): translation, m, and rotation, rad.

    Returns:
        The transform (4, 4).
    """
    rho, phi = np.asarray(xi[:3], np.float64), np.asarray(xi[3:], np.float64)
    theta = math.sqrt(phi @ phi)
    W = skew(phi)
    WW = W @ W
    A = _sinc(theta)
    B = _sinc(theta / 2) ** 2 / 2  # (1 - cos(theta)) / theta^2 without cancellation
    # (theta - sin(theta)) / theta^3; for small angles a series (error theta^6), which avoids cancellation
    C = (theta - math.sin(theta)) / theta**3 if theta > 1e-2 else 1 / 6 - theta**2 / 120 + theta**4 / 5040
    T = np.eye(4)
    T[:3, :3] += A * W + B * WW
    T[:3, 3] = rho + B * (W @ rho) + C * (WW @ rho)
    return T


def _sinc(x: float) -> float:
    return math.sin(x) / x if x else 1.0


def camera_of(camera: Camera | Float64, image: UInt8) -> Camera:
    """Return a camera given as such, or as the intrinsic matrix of an image (H, W, ...).

    The matrix may be padded to (3, 4) with a column of zeros, or to (4, 4) with a row and a column of the identity.

    Raises:
        DataError: The matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px.
    """
    if isinstance(camera, Camera):
        return camera
    form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px"
    K = as_array("camera", camera, f"a Camera or {form}")
    if K.shape in ((3, 4), (4, 4)) and not (K[:3, 3:].any() or (K[3:] != (0, 0, 0, 1)).any()):
        K = K[:3, :3]
    if K.shape != (3, 3):
        raise DataError(f"camera: expected a Camera or {form}, got an array of shape {K.shape}")
    if not np.allclose(K, [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]], rtol=0, atol=MAX_SKEW):
        fix = "; undistort and unskew the images first" if abs(K[0, 1]) > MAX_SKEW else ""
        raise DataError(f"camera: expected {form}, got {K.tolist()}{fix}")
    height, width = np.shape(image)[:2] if np.ndim(image) >= 2 else (0, 0)
    return Camera(width, height, *(float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))


def pose_of(where: str, pose: object) -> Float64:
    """Return a transform (4, 4) given as an array, tensor or list of numbers of any type, (4, 4) or (3, 4).

    Raises:
        DataError: The matrix is not rigid. The message begins with `where`.
    """
    form = "a rigid transform (4, 4)"
    T = as_array(f"{where}: pose", pose, form)
    if T.shape == (3, 4):
        T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
    if T.shape != (4, 4):
        raise DataError(f"{where}: pose: expected {form}, got an array of shape {T.shape}; pass R and t in one matrix")
    with errors_of(where):
        return nearest_rigid(T)


def as_array(name: str, value: object, form: str) -> Float64:
    """Return an array, tensor or list of numbers as float64.

    Raises:
        DataError: The value is not an array of real numbers in the given form, or it has masked entries.
    """
    try:
        found = np.asarray(value)
        if found.dtype.kind == "c" or np.ma.is_masked(value):
            raise DataError(f"{name}: expected {form}, got an array with complex or masked entries")
        return np.asarray(found, np.float64)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor on another device, or with a gradient
        raise DataError(f"{name}: expected {form}, got {type(value).__name__}") from None


def rotation_angle(R: Float64) -> float:
    """Return the angle of a rotation matrix (3, 3) in rad."""
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return float(np.arctan2(sine, (np.trace(R) - 1) / 2))


def pose_distance(T_world_a: Float64, T_world_b: Float64) -> float:
    """Return the distance, m, or the rotation angle, rad, between two poses (4, 4), whichever is larger."""
    T_a_b = inverse(T_world_a) @ T_world_b
    return max(float(np.linalg.norm(T_a_b[:3, 3])), rotation_angle(T_a_b[:3, :3]))


def nearest_rotation(R: Float64) -> Float64:
    """Return the nearest rotation matrix (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(R)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def nearest_rigid(matrix: Float64) -> Float64:
    """Return the nearest rigid transform (4, 4), for example to remove rounding errors.

    Raises:
        DataError: The matrix is not finite, or differs from a rigid transform by more than RIGID_WITHIN.
    """
    if not np.isfinite(matrix).all():
        raise DataError("pose: expected finite values, got NaN or infinity")
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise DataError(f"pose: expected the last row 0 0 0 1, got {matrix[3].tolist()}")
    R = matrix[:3, :3]
    with np.errstate(all="ignore"):  # files may contain numbers of any size
        error, determinant = float(np.abs(R @ R.T - np.eye(3)).max()), float(np.linalg.det(R))
    if not (error <= RIGID_WITHIN and determinant > 0):
        raise DataError(f"pose: expected a rigid transform, got |R R^T - I| = {error:.2g}, det R = {determinant:.2g}")
    T = np.eye(4)
    T[:3, :3] = R if error <= EXACT_WITHIN else nearest_rotation(R)
    T[:3, 3] = matrix[:3, 3]
    return T


def interpolate(T_world_a: Float64, T_world_b: Float64, fraction: float) -> Float64:
    """Interpolate between two poses (4, 4).

    The translation is interpolated linearly, and the rotation spherically (slerp).

    Args:
        T_world_a: The first pose (4, 4).
        T_world_b: The second pose (4, 4).
        fraction: The position between the poses, from 0 (first) to 1 (second).
    """
    R_a, R_b = T_world_a[:3, :3], T_world_b[:3, :3]
    T = np.eye(4)
    rotation_vector, _ = cv2.Rodrigues(R_a.T @ R_b)  # ten times as fast as SciPy's conversions
    T[:3, :3] = R_a @ cv2.Rodrigues(fraction * rotation_vector)[0]
    T[:3, 3] = (1 - fraction) * T_world_a[:3, 3] + fraction * T_world_b[:3, 3]
    return T


def project(camera: Camera, points_camera: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Project points in front of a camera to the image.

    Args:
        camera: The camera.
        points_camera: The points (..., 3) in the camera frame, m, with z > 0.

    Returns:
        The pixel coordinates (u, v) (..., 2), px.
    """
    x, y, z = points_camera[..., 0], points_camera[..., 1], points_camera[..., 2]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)


def back_project(camera: Camera, pixels: Int32 | Float32, depth: Float32) -> Float32:
    """Return the 3D points of pixels with known depth.

    Args:
        camera: The camera.
        pixels: The pixel coordinates (u, v) (P, 2), px.
        depth: The depths (P,) along z, m.

    Returns:
        The points (P, 3) in the camera frame, m.
    """
    x = (pixels[:, 0] - np.float32(camera.cx)) * (depth / np.float32(camera.fx))
    y = (pixels[:, 1] - np.float32(camera.cy)) * (depth / np.float32(camera.fy))
    return np.stack([x, y, depth], axis=1).astype(np.float32, copy=False)


def sampled_camera(camera: Camera, step: int) -> Camera:
    """Return the camera whose pixels are every step-th pixel of an image, from pixel step // 2."""
    height, width = (len(range(step // 2, side, step)) for side in camera.shape)
    fx, fy, cx, cy = (value / step for value in (camera.fx, camera.fy, camera.cx - step // 2, camera.cy - step // 2))
    return Camera(width, height, fx, fy, cx, cy)


def require_pixels_inside(clusters: PointClusters, shape: tuple[int, int]) -> None:
    """Raise DataError if a pixel of `clusters` is outside of an image of size `shape` (height, width), px.

    Kernels access images at these pixels without bounds checks.
    """
    u, v = clusters.pixels.T
    if len(u) and not (u.min() >= 0 and u.max() < shape[1] and v.min() >= 0 and v.max() < shape[0]):
        raise DataError(
            f"clusters: expected pixels in the image of {shape[1]}x{shape[0]} px, got u in [{u.min()}, "
            f"{u.max()}], v in [{v.min()}, {v.max()}]"
        )
