"""Kernels of ambient_occlusion.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32

RAYS = 8  # per pixel; neighbours in tiles of 4x4 pixels look elsewhere, and the tile is averaged
STEPS = 4  # along a ray, at which it is asked whether it lies behind what the picture shows
TILE = 4  # px
SLACK_M = np.float32(2e-3)  # a ray that is not farther behind the surface than this has not met it
THICKNESS_M = np.float32(0.15)  # what is seen is taken to reach this far back; a ray that is farther behind passes
HALF = np.float32(0.5)  # px, from a pixel's border to its middle


@njit(cache=True, nogil=True)
def block_light(
    depth: Float32, normals: Float32, K: Float32, directions: Float32, reaches: Float32, blocked: Float32
) -> None:
    """Writes the share (H, W) of each pixel's rays that meet something."""
    height, width = depth.shape
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z <= 0:
                continue
            x, y = (np.float32(u) - cx) / fx * z, (np.float32(v) - cy) / fy * z
            n = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            s, t = _tangents(n)
            place = v % TILE * TILE + u % TILE
            met = 0
            for ray in range(RAYS):
                a, b, c = directions[place, ray, 0], directions[place, ray, 1], directions[place, ray, 2]
                dx = a * s[0] + b * t[0] + c * n[0]
                dy = a * s[1] + b * t[1] + c * n[1]
                dz = a * s[2] + b * t[2] + c * n[2]
                for step in range(STEPS):
                    reach = reaches[place, step]
                    far = z + reach * dz
                    if far <= 0:
                        break
                    scale = np.float32(1) / far
                    column = int(np.floor(fx * (x + reach * dx) * scale + cx + HALF))
                    row = int(np.floor(fy * (y + reach * dy) * scale + cy + HALF))
                    if not (0 <= column < width and 0 <= row < height):
                        break
                    there = depth[row, column]
                    if there > 0 and SLACK_M < far - there < THICKNESS_M:
                        met += 1
                        break
            blocked[v, u] = met / RAYS


@njit(cache=True, nogil=True, inline="always")
def _tangents(n):
    """Two unit vectors at right angles to the unit vector n and to each other (Duff et al., JCGT 6(1), 2017)."""
    sign = np.float32(1) if n[2] >= 0 else np.float32(-1)
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
