"""Kernels of lit_view.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, Int32

TO_LAMP = np.array([-0.45, -0.75, -0.6])  # direction to the lamp, camera frame: above and to the left of the viewer
LAMP = TO_LAMP / np.linalg.norm(TO_LAMP)
AMBIENT, DIFFUSE = 0.70, 0.34  # relative brightness of ambient light, and of the lamp at perpendicular incidence


@njit(cache=True, nogil=True)
def light_up(normals: Float32, R_world_camera: Float64, K: Float64, light: Float32) -> None:
    """Compute the brightness of each pixel, and normalize the normals.

    Args:
        normals: The normals (H, W, 3) in the world frame. They are replaced by unit normals toward the camera in the
            camera frame.
        R_world_camera: The rotation (3, 3) of the camera.
        K: The camera matrix (3, 3), px.
        light: The output (H, W), the relative brightness.
    """
    R = R_world_camera
    for v in range(normals.shape[0]):
        y = (v - K[1, 2]) / K[1, 1]
        for u in range(normals.shape[1]):
            n = normals[v, u]
            nx = R[0, 0] * n[0] + R[1, 0] * n[1] + R[2, 0] * n[2]
            ny = R[0, 1] * n[0] + R[1, 1] * n[1] + R[2, 1] * n[2]
            nz = R[0, 2] * n[0] + R[1, 2] * n[1] + R[2, 2] * n[2]
            away = (u - K[0, 2]) / K[0, 0] * nx + y * ny + nz > 0
            scale = (-1 if away else 1) / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            n[0], n[1], n[2] = scale * nx, scale * ny, scale * nz
            light[v, u] = AMBIENT + DIFFUSE * max(n[0] * LAMP[0] + n[1] * LAMP[1] + n[2] * LAMP[2], 0.0)


@njit(cache=True, nogil=True)
def paint(ids: Int32, gray: Float32, palette: Float32, painted: Float32) -> None:
    """Compute the unlit instance color of each pixel, with darker borders.

    Args:
        ids: The instance (H, W) at each pixel, 0 = none.
        gray: The brightness (H, W) of the surface in [0, 255], which adds texture to the colors.
        palette: The color (N, 3) of each instance by id, RGB.
        painted: The output (H, W, 3), RGB.
    """
    height, width = ids.shape
    for v in range(height):
        for u in range(width):
            instance = ids[v, u]
            border = (
                (u > 0 and ids[v, u - 1] != instance)
                or (u < width - 1 and ids[v, u + 1] != instance)
                or (v > 0 and ids[v - 1, u] != instance)
                or (v < height - 1 and ids[v + 1, u] != instance)
            )
            dim = np.float32(0.45 if border else 1)
            background = np.float32(0.22) * gray[v, u] + np.float32(178)  # pale, so that the instances stand out
            texture = np.float32(0.84) + np.float32(0.16 / 140) * gray[v, u]
            for k in range(3):
                painted[v, u, k] = dim * (palette[instance, k] * texture if instance > 0 else background)
