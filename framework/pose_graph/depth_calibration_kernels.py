"""Kernels of depth_calibration.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit

CORNERS = 4  # number of nodes around a pixel


@njit(cache=True, nogil=True)
def find_corners(v, u, shape, rows, columns, corners, weights):
    """Write the numbers of the nodes around a pixel to `corners` (4,), and their weights to `weights` (4,)."""
    y = v * (rows - 1) / max(shape[0] - 1, 1)
    x = u * (columns - 1) / max(shape[1] - 1, 1)
    j, i = min(int(y), rows - 2), min(int(x), columns - 2)
    b, a = y - j, x - i
    first = j * columns + i
    corners[0], corners[1], corners[2], corners[3] = first, first + 1, first + columns, first + columns + 1
    weights[0], weights[1], weights[2], weights[3] = (1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a


@njit(cache=True, nogil=True)
def distortion_at(corners, weights, nodes):
    """Return the correction d at a pixel, 1/m."""
    return (
        weights[0] * nodes[corners[0]]
        + weights[1] * nodes[corners[1]]
        + weights[2] * nodes[corners[2]]
        + weights[3] * nodes[corners[3]]
    )


@njit(cache=True, nogil=True, parallel=True)
def linearize_pairs(
    pairs, depths, normals, T_world_view, camera, stride, nodes, columns, noise, max_distance, min_cosine, A, b,
    A_nodes, b_nodes, A_cross, errors,
):  # fmt: skip
    """Linearize the distances between the surfaces of pairs of views.

    Each point p of the first view, at every `stride`-th pixel, is compared with the point at the nearest pixel of the
    second view. The residual is their distance along the normal of the second point. Its weight is that of a Cauchy
    distribution. The unknowns are the twists xi of both views, T_world_view <- T_world_view exp(xi), and the nodes.

    Args:
        pairs: The pairs of views (P, 2).
        depths: The depth images (V, h, w), m, 0 = no point.
        normals: The unit normals in the camera frames (V, h, w, 3).
        T_world_view: The poses (V, 4, 4).
        camera: fx, fy, cx, cy of the depth images, px.
        stride: The step between pixels, px.
        nodes: The corrections d (R C,), 1/m.
        columns: The number of columns C.
        noise: The standard deviation sigma = noise[0] + noise[1] z^2 of a distance, m.
        max_distance: The maximum distance in addition to 4 sigma, m.
        min_cosine: The minimum cosine of the angle between the normals.
        A: The output (P, 12, 12) of the poses.
        b: The output (P, 12).
        A_nodes: The output (P, R C, R C).
        b_nodes: The output (P, R C).
        A_cross: The output (P, 12, R C).
        errors: The output (P, 2): the number of residuals and the sum of their weighted squares.
    """
    _, height, width = depths.shape
    fx, fy, cx, cy = camera
    rows = nodes.shape[0] // columns
    for k in prange(pairs.shape[0]):
        first, second = pairs[k, 0], pairs[k, 1]
        R_a, t_a = T_world_view[first, :3, :3], T_world_view[first, :3, 3]
        R_b, t_b = T_world_view[second, :3, :3], T_world_view[second, :3, 3]
        R = np.zeros((3, 3))
        t = np.zeros(3)
        for i in range(3):
            for m in range(3):
                t[i] += R_b[m, i] * (t_a[m] - t_b[m])
                for j in range(3):
                    R[i, j] += R_b[m, i] * R_a[m, j]
        corners, weights = np.zeros(8, np.int64), np.zeros(8)
        J = np.zeros(20)
        count, error = 0, 0.0
        for v in range(stride // 2, height, stride):
            for u in range(stride // 2, width, stride):
                z_a = np.float64(depths[first, v, u])
                if z_a <= 0.0:
                    continue
                find_corners(v, u, (height, width), rows, columns, corners[:4], weights[:4])
                z = z_a + z_a * z_a * distortion_at(corners[:4], weights[:4], nodes)
                ray_x, ray_y = (u - cx) / fx, (v - cy) / fy
                x, y = ray_x * z, ray_y * z
                q_x = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
                q_y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
                q_z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
                if q_z <= 0.1:
                    continue
                column, row = int(np.rint(fx * q_x / q_z + cx)), int(np.rint(fy * q_y / q_z + cy))
                if column < 0 or row < 0 or column >= width or row >= height:
                    continue
                z_b = np.float64(depths[second, row, column])
                if z_b <= 0.0:
                    continue
                n = normals[second, row, column]
                m_a = normals[first, v, u]
                n_x, n_y, n_z = np.float64(n[0]), np.float64(n[1]), np.float64(n[2])
                # the normal in the frame of the first view
                o_x = R[0, 0] * n_x + R[1, 0] * n_y + R[2, 0] * n_z
                o_y = R[0, 1] * n_x + R[1, 1] * n_y + R[2, 1] * n_z
                o_z = R[0, 2] * n_x + R[1, 2] * n_y + R[2, 2] * n_z
                if o_x * m_a[0] + o_y * m_a[1] + o_z * m_a[2] < min_cosine:
                    continue
                find_corners(row, column, (height, width), rows, columns, corners[4:], weights[4:])
                p_z = z_b + z_b * z_b * distortion_at(corners[4:], weights[4:], nodes)
                other_x, other_y = (column - cx) / fx, (row - cy) / fy
                r = n_x * (q_x - other_x * p_z) + n_y * (q_y - other_y * p_z) + n_z * (q_z - p_z)
                largest = max(z_a, z_b)
                sigma = noise[0] + noise[1] * largest * largest
                if abs(r) > max(max_distance, 4 * sigma):
                    continue
                J[0], J[1], J[2] = o_x, o_y, o_z
                J[3], J[4], J[5] = y * o_z - z * o_y, z * o_x - x * o_z, x * o_y - y * o_x
                J[6], J[7], J[8] = -n_x, -n_y, -n_z
                J[9], J[10], J[11] = q_z * n_y - q_y * n_z, q_x * n_z - q_z * n_x, q_y * n_x - q_x * n_y
                slope_a = (o_x * ray_x + o_y * ray_y + o_z) * z_a * z_a
                slope_b = -(n_x * other_x + n_y * other_y + n_z) * z_b * z_b
                for i in range(4):
                    J[12 + i] = slope_a * weights[i]
                    J[16 + i] = slope_b * weights[4 + i]
                scaled = r / (2 * sigma)
                weight = 1 / (sigma * sigma * (1 + scaled * scaled))
                count += 1
                error += weight * r * r
                for i in range(12):
                    b[k, i] += weight * J[i] * r
                    for j in range(12):
                        A[k, i, j] += weight * J[i] * J[j]
                    for j in range(8):
                        A_cross[k, i, corners[j]] += weight * J[i] * J[12 + j]
                for i in range(8):
                    b_nodes[k, corners[i]] += weight * J[12 + i] * r
                    for j in range(8):
                        A_nodes[k, corners[i], corners[j]] += weight * J[12 + i] * J[12 + j]
        errors[k, 0] = count
        errors[k, 1] = error
