"""Coarse depth brought to the pixels of a colour image, without readings between two surfaces.

Where the four readings around a pixel are of one surface, their inverses are interpolated, which is exact for a plane.
Elsewhere the pixel takes one of the four, that with the nearest and most similar colour (the weights of joint bilateral
upsampling, Kopf et al., SIGGRAPH 2007, which choose here and do not mix). A hole stays a hole.

Measured on 7-Scenes' kitchen (640x480) and Replica (512x512), depth thinned to 256x192 and 205x205 and back:

    share of pixels                               nearest reading    bilinear         this
    more than 2 % from all true readings near     0.00 %, 0.36 %     5.18 %, 2.43 %   0.00 %, 0.53 %
    off by more than 5 cm                         0.44 %, 1.00 %     5.30 %, 1.42 %   0.40 %, 0.65 %
    off by more than 2 %                          0.47 %, 6.84 %     5.50 %, 4.63 %   0.41 %, 3.62 %
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, UInt8

ONE_SURFACE = 0.05  # of the nearest of four readings, by which the farthest may be farther
COLOR_SIGMA = 15.0  # of 255, root of the summed squares of R, G, B: noise and shading of one thing


def upsampled(depth: Float32, color: UInt8, camera: Camera, target: Camera, target_color: UInt8) -> Float32:
    """Depth (H, W) m of the camera `target` from depth (h, w) m of the whole image of `camera`.

    `color` and `target_color` are the images (., ., 3) of the two cameras, which look from one place in one direction.
    """
    height, width = depth.shape
    guide = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    u = _coordinates(target.width, target.fx, target.cx, camera.fx, camera.cx, width / camera.width)
    v = _coordinates(target.height, target.fy, target.cy, camera.fy, camera.cy, height / camera.height)
    found = np.zeros(target.shape, np.float32)
    _upsample(depth, guide, u, v, target_color, found)
    return found


def _coordinates(size: int, f_target: float, c_target: float, f: float, c: float, scale: float) -> Float64:
    """Where (size,) the pixels of a target's row or column lie in the depth image."""
    in_color = (np.arange(size) - c_target) * (f / f_target) + c
    return np.asarray((in_color + 0.5) * scale - 0.5, np.float64)


@njit(cache=True, nogil=True)
def _upsample(depth: Float32, guide: UInt8, u: Float64, v: Float64, color: UInt8, found: Float32) -> None:
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
