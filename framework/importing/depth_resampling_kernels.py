"""Kernels of depth_resampling.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, UInt8

ONE_SURFACE = 0.05  # maximum range of four depth readings on one surface, as a fraction of the nearest reading
COLOR_SIGMA = 15.0  # standard deviation of RGB distances within one object, for channels from 0 to 255


@njit(cache=True, nogil=True)
def move_readings(depth: Float32, K: Float64, K_target: Float64, T: Float64, registered: Float32) -> None:
    """Project depth readings to another camera.

    If several readings project to a pixel, the nearest reading is kept.

    Args:
        depth: The depth (h, w), m, 0 = no reading.
        K: The intrinsic matrix (3, 3) of the depth camera, px.
        K_target: The intrinsic matrix (3, 3) of the target camera, px.
        T: The transform (4, 4) from the depth camera to the target camera.
        registered: The output depth (H, W), m, initially 0.
    """
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


@njit(cache=True, nogil=True)
def upsample(depth: Float32, guide: UInt8, u: Float64, v: Float64, color: UInt8, found: Float32) -> None:
    """Resample a depth image to the resolution of a color image.

    The method is described in `upsampled`.

    Args:
        depth: The depth (h, w), m, 0 = no reading.
        guide: The color image (h, w, 3) at the resolution of `depth`, RGB.
        u: The coordinate (W,) in `depth` of each column of the target, px.
        v: The coordinate (H,) in `depth` of each row of the target, px.
        color: The color image (H, W, 3) of the target, RGB.
        found: The output depth (H, W), m, initially 0.
    """
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
