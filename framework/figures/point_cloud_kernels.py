"""Kernels of point_cloud.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Int32


@njit(cache=True, nogil=True)
def splat_points(pixels: Float32, depth: Float32, radius: Float32, nearest: Int32, buffer: Float32) -> None:
    height, width = buffer.shape
    for i in range(len(depth)):
        u, v, r = pixels[i, 0], pixels[i, 1], radius[i]
        if not (-r - 1 <= u <= width + r and -r - 1 <= v <= height + r):  # NaN neither
            continue
        column, row, reach = int(np.rint(u)), int(np.rint(v)), int(r)
        for y in range(max(row - reach, 0), min(row + reach + 1, height)):
            for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                if (x - column) ** 2 + (y - row) ** 2 <= r * r and depth[i] < buffer[y, x]:
                    buffer[y, x] = depth[i]
                    nearest[y, x] = i
