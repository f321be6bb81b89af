"""Kernels of ambient_occlusion.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32

RAYS = 8  # number of rays per pixel
STEPS = 4  # number of samples along a ray
TILE = 4  # side of a tile, px; rays differ between the pixels of a tile, and the result is averaged over a tile
SLACK_M = np.float32(2e-3)  # minimum distance of an occluded sample behind the surface, along z
THICKNESS_M = np.float32(0.15)  # assumed thickness of surfaces along z; samples farther behind are not occluded
HALF = np.float32(0.5)  # px, distance from the border of a pixel to its center


@njit(cache=True, nogil=True)
def trace_occlusion(
    depth: Float32, normals: Float32, K: Float32, directions: Float32, reaches: Float32, occluded: Float32
) -> None:
    """Compute the fraction of occluded rays at each pixel.

    Args:
        depth: The depth image (H, W), m, 0 = no surface.
        normals: The unit normals (H, W, 3) in the camera frame.
        K: The camera matrix (3, 3), px.
        directions: The unit ray directions (TILE^2, RAYS, 3) along two tangents and the normal.
        reaches: The distances (TILE^2, STEPS) of the samples along a ray, m.
        occluded: The output (H, W) in [0, 1].
    """
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
            offset = v % TILE * TILE + u % TILE
            hits = 0
            for ray in range(RAYS):
                a, b, c = directions[offset, ray, 0], directions[offset, ray, 1], directions[offset, ray, 2]
                dx = a * s[0] + b * t[0] + c * n[0]
                dy = a * s[1] + b * t[1] + c * n[1]
                dz = a * s[2] + b * t[2] + c * n[2]
                for step in range(STEPS):
                    reach = reaches[offset, step]
                    far = z + reach * dz
                    if far <= 0:
                        break
                    scale = np.float32(1) / far
                    column = int(np.floor(fx * (x + reach * dx) * scale + cx + HALF))
                    row = int(np.floor(fy * (y + reach * dy) * scale + cy + HALF))
                    if not (0 <= column < width and 0 <= row < height):
                        break
                    surface = depth[row, column]
                    if surface > 0 and SLACK_M < far - surface < THICKNESS_M:
                        hits += 1
                        break
            occluded[v, u] = hits / RAYS


@njit(cache=True, nogil=True, inline="always")
def _tangents(n):
    """Return two orthonormal tangents of a unit normal."""
    sign = np.float32(1) if n[2] >= 0 else np.float32(-1)  # Duff et al., JCGT 6(1), 2017
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
