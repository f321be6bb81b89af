"""Kernels of surface.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Int32
from framework.rendering.rasterizer_kernels import NO_TRIANGLE


@njit(cache=True, nogil=True)
def interpolate(triangle: Int32, uv: Float32, triangles: Int32, values: Float32, image: Float32) -> None:
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            if f == NO_TRIANGLE:
                continue
            a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
            wb, wc = uv[v, u, 0], uv[v, u, 1]
            wa = np.float32(1) - wb - wc
            for k in range(values.shape[1]):
                image[v, u, k] = wa * values[a, k] + wb * values[b, k] + wc * values[c, k]
