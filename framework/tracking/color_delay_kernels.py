"""Kernels of color_delay.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

DEPTH_STEP = 0.05  # minimum depth step of an edge, fraction of the depth
REACH = 4  # px, maximum width of the missing depth at an edge
DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # (u, v) of the searched neighbors
SEARCHED_ROWS = 120  # number of searched rows of an image


@njit(cache=True, nogil=True)
def find_edges(depth, edges):
    """Write (u, v, z), px and m, of pixels on the nearer side of depth steps to edges (N, 3). Return their number."""
    height, width = depth.shape
    count = 0
    for v in range(REACH, height - REACH, max(height // SEARCHED_ROWS, 1)):
        for u in range(REACH, width - REACH):
            z = depth[v, u]
            if z <= np.float32(0.0):
                continue
            behind = z * np.float32(1.0 + DEPTH_STEP)
            found = False
            for du, dv in DIRECTIONS:
                for k in range(1, REACH + 1):
                    neighbor = depth[v + k * dv, u + k * du]
                    if neighbor > np.float32(0.0):
                        found = found or neighbor > behind
                        break
            if found and count < edges.shape[0]:
                edges[count, 0], edges[count, 1], edges[count, 2] = u, v, z
                count += 1
    return count


@njit(cache=True, nogil=True, parallel=True)
def mean_gradients(points, transforms, intrinsics, scale, gradient, means):
    """Set means (D,) to the mean gradient at the points (P, 3), m, moved by each of the transforms (D, 3, 4).

    `gradient` (h, w) is at `scale` times the resolution of the intrinsics (fx, fy, cx, cy). Points outside of the image
    are ignored.
    """
    fx, fy, cx, cy = intrinsics
    half, one = np.float32(0.5), np.float32(1.0)
    height, width = gradient.shape
    for d in prange(transforms.shape[0]):
        T = transforms[d]
        total = 0.0
        count = 0
        for n in range(points.shape[0]):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if pz < np.float32(0.05):
                continue
            u = (fx * px / pz + cx + half) * scale - half
            v = (fy * py / pz + cy + half) * scale - half
            column, row = np.int32(np.floor(u)), np.int32(np.floor(v))
            if column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
                continue
            a, b = u - np.float32(column), v - np.float32(row)
            top = gradient[row, column] * (one - a) + gradient[row, column + 1] * a
            low = gradient[row + 1, column] * (one - a) + gradient[row + 1, column + 1] * a
            total += top * (one - b) + low * b
            count += 1
        means[d] = total / max(count, 1)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def locate_colors(depth, otherwise, intrinsics, T_color_depth, columns, rows, pixels):
    """Set columns and rows (H, W), px, to the position in the color image of each pixel of `depth`.

    `pixels` (H, W) is set to the flat index of the nearest color pixel, -1 outside of the color image and without a
    reading. Positions outside are moved to the border. Pixels without a reading have an assumed depth `otherwise`, m.
    """
    fx, fy, cx, cy = intrinsics
    R, t = T_color_depth[:, :3], T_color_depth[:, 3]
    R00, R01, R02, R10, R11, R12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    R20, R21, R22 = R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    height, width = depth.shape
    one, zero, half, stride = np.float32(1.0), np.float32(0.0), np.float32(0.5), np.int32(width)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    inv_fx = one / fx
    for v in prange(height):
        y = (np.float32(v) - cy) / fy
        row_x, row_y, row_z = R01 * y + R02, R11 * y + R12, R21 * y + R22
        for u in range(width):
            z = depth[v, u]
            measured = z > zero
            z = z if measured else otherwise
            x = (np.float32(np.int32(u)) - cx) * inv_fx
            inv_z = one / max((R20 * x + row_z) * z + t2, np.float32(0.05))
            column = fx * ((R00 * x + row_x) * z + t0) * inv_z + cx
            row = fy * ((R10 * x + row_y) * z + t1) * inv_z + cy
            inside = (column > -half) & (row > -half) & (column < right + half) & (row < bottom + half)
            column, row = min(max(column, zero), right), min(max(row, zero), bottom)
            columns[v, u], rows[v, u] = column, row
            nearest = np.int32(row + half) * stride + np.int32(column + half)
            pixels[v, u] = nearest if inside & measured else np.int32(-1)
