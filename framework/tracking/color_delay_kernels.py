"""Kernels of color_delay.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit

DEPTH_STEP = 0.05  # minimum depth step of an edge, fraction of the depth
REACH = 4  # px, maximum width of the missing depth at an edge
DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # (u, v) of the searched neighbors
SEARCHED_ROWS = 120  # number of searched rows of an image


@njit(cache=True, nogil=True)
def find_edges(depth, edges):
    """Find pixels on the nearer side of depth edges, and return their number.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        edges: The output (N, 3): u, v, px, and depth, m. At most N pixels are written.
    """
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
    """Compute the mean gradient at the projections of points, for several camera motions.

    Points outside the image are ignored.

    Args:
        points: The points (P, 3), m.
        transforms: The transforms (D, 3, 4) of the points into the camera frame.
        intrinsics: The intrinsics fx, fy, cx, cy, px.
        scale: The resolution of `gradient` relative to the intrinsics.
        gradient: The gradient image (h, w).
        means: The output (D,), 0 if no point is inside the image.
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
