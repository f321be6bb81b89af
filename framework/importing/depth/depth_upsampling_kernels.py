"""Kernels of depth_upsampling.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Float64, UInt8

ONE_SURFACE = 0.05  # of the nearest of four readings, by which the farthest may be farther
COLOR_SIGMA = 15.0  # of 255, root of the summed squares of R, G, B: noise and shading of one thing


@njit(cache=True, nogil=True)
def upsample(depth: Float32, guide: UInt8, u: Float64, v: Float64, color: UInt8, found: Float32) -> None:
    """Fills `found` (H, W) at the coordinates u (W,), v (H,) of depth (h, w), whose colours are guide (h, w, 3)."""
    height, width = depth.shape
    for row in range(len(v)):
        if not -0.5 <= v[row] <= height - 0.5:
            continue
        y = min(max(v[row], 0.0), height - 1.0)
        v_0 = min(int(y), height - 2)
        for column in range(len(u)):
            if not -0.5 <= u[column] <= width - 0.5:
                continue
            x = min(max(u[column], 0.0), width - 1.0)
            u_0 = min(int(x), width - 2)
            if depth[v_0 + int(y - v_0 + 0.5), u_0 + int(x - u_0 + 0.5)] == 0:
                continue
            nearest, farthest = np.inf, 0.0
            inverse = 0.0
            best, chosen = -1.0, 0.0
            for k in range(4):
                i, j = v_0 + k // 2, u_0 + k % 2
                z = depth[i, j]
                nearest, farthest = min(nearest, z), max(farthest, z)
                if z == 0:
                    continue
                weight = (1 - abs(y - i)) * (1 - abs(x - j))
                inverse += weight / z
                difference = 0.0
                for channel in range(3):
                    difference += (float(guide[i, j, channel]) - float(color[row, column, channel])) ** 2
                likeness = weight * np.exp(-difference / (2 * COLOR_SIGMA**2))
                if likeness > best:
                    best, chosen = likeness, z
            one_surface = nearest > 0 and farthest <= (1 + ONE_SURFACE) * nearest
            found[row, column] = 1 / inverse if one_surface else chosen
