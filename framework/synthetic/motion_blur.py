"""The blur of a moving camera: each pixel is the mean of what passes over it while the shutter is open."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, UInt8
from framework.geometry import inverse

MOST_SAMPLES = 9  # along the path of a pixel; more would show in no picture
SHARP = np.float32(0.5)  # px, a shorter path is no blur


def blurred(
    color: UInt8, depth: Float32, camera: Camera, T_world_camera: Float64, T_world_open: Float64, T_world_close: Float64
) -> UInt8:
    """`color` (H, W, 3), seen from T_world_camera, as exposed from the pose T_world_open to the pose T_world_close.

    The paths of the pixels come from the exact `depth` (H, W) m of the room, which stands still; 0 = no path.
    """
    picture = np.empty_like(color)
    K = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    T_open_camera, T_close_camera = (
        (inverse(end) @ T_world_camera).astype(np.float32) for end in (T_world_open, T_world_close)
    )
    _blur(color, depth, K, T_open_camera, T_close_camera, picture)
    return picture


@njit(cache=True, nogil=True)
def _blur(
    color: UInt8, depth: Float32, K: Float32, T_open_camera: Float32, T_close_camera: Float32, picture: UInt8
) -> None:
    """Writes the mean of up to MOST_SAMPLES samples of `color`, evenly along each pixel's path."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            u0, v0 = _seen_at(T_open_camera, K, u, v, depth[v, u])
            u1, v1 = _seen_at(T_close_camera, K, u, v, depth[v, u])
            length = np.sqrt((u1 - u0) * (u1 - u0) + (v1 - v0) * (v1 - v0))
            if not length >= SHARP:
                for c in range(3):
                    picture[v, u, c] = color[v, u, c]
                continue
            samples = min(int(np.ceil(length)) + 1, MOST_SAMPLES)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for k in range(samples):
                along = (np.float32(k) + np.float32(0.5)) / np.float32(samples)
                x = min(max(u0 + along * (u1 - u0), np.float32(0)), np.float32(width - 1))
                y = min(max(v0 + along * (v1 - v0), np.float32(0)), np.float32(height - 1))
                i, j = min(int(x), width - 2), min(int(y), height - 2)
                a, b = x - np.float32(i), y - np.float32(j)
                w00, w10 = (1 - a) * (1 - b), a * (1 - b)
                w01, w11 = (1 - a) * b, a * b
                red += w00 * color[j, i, 0] + w10 * color[j, i + 1, 0]
                red += w01 * color[j + 1, i, 0] + w11 * color[j + 1, i + 1, 0]
                green += w00 * color[j, i, 1] + w10 * color[j, i + 1, 1]
                green += w01 * color[j + 1, i, 1] + w11 * color[j + 1, i + 1, 1]
                blue += w00 * color[j, i, 2] + w10 * color[j, i + 1, 2]
                blue += w01 * color[j + 1, i, 2] + w11 * color[j + 1, i + 1, 2]
            share = np.float32(1) / np.float32(samples)
            picture[v, u, 0] = np.uint8(red * share + np.float32(0.5))
            picture[v, u, 1] = np.uint8(green * share + np.float32(0.5))
            picture[v, u, 2] = np.uint8(blue * share + np.float32(0.5))


@njit(cache=True, nogil=True, inline="always")
def _seen_at(T, K, u, v, z):  # type: ignore[no-untyped-def]
    """Where (px, px) the point that pixel u, v shows at depth z is seen from the other pose; there itself at z = 0."""
    px, py = (np.float32(u) - K[2]) / K[0] * z, (np.float32(v) - K[3]) / K[1] * z
    ahead = T[2, 0] * px + T[2, 1] * py + T[2, 2] * z + T[2, 3]
    if z <= 0 or ahead <= 0:
        return np.float32(u), np.float32(v)
    right = T[0, 0] * px + T[0, 1] * py + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * px + T[1, 1] * py + T[1, 2] * z + T[1, 3]
    return K[0] * right / ahead + K[2], K[1] * down / ahead + K[3]
