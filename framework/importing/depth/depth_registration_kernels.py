"""Kernels of depth_registration.py."""

from __future__ import annotations

from numba import njit

from framework.data import Float32, Float64


@njit(cache=True, nogil=True)
def move_readings(depth: Float32, K: Float64, K_target: Float64, T: Float64, registered: Float32) -> None:
    height, width = registered.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if z == 0:
                continue
            x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
            depth_there = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if depth_there <= 0:
                continue
            x_there = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            y_there = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            u_float = K_target[0, 0] * x_there / depth_there + K_target[0, 2] + 0.5
            v_float = K_target[1, 1] * y_there / depth_there + K_target[1, 2] + 0.5
            if not (0 <= u_float < width and 0 <= v_float < height):
                continue
            i, j = int(v_float), int(u_float)
            if registered[i, j] == 0 or depth_there < registered[i, j]:
                registered[i, j] = depth_there
