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

from framework.data import Camera, Float32, Float64, UInt8
from framework.importing.depth.depth_upsampling_kernels import upsample


def upsampled(depth: Float32, color: UInt8, camera: Camera, target: Camera, target_color: UInt8) -> Float32:
    """Depth (H, W) m of the camera `target` from depth (h, w) m of the whole image of `camera`.

    `color` and `target_color` are the images (., ., 3) of the two cameras, which look from one place in one direction.
    """
    height, width = depth.shape
    guide = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    u = _coordinates(target.width, target.fx, target.cx, camera.fx, camera.cx, width / camera.width)
    v = _coordinates(target.height, target.fy, target.cy, camera.fy, camera.cy, height / camera.height)
    found = np.zeros(target.shape, np.float32)
    upsample(depth, guide, u, v, target_color, found)
    return found


def _coordinates(size: int, f_target: float, c_target: float, f: float, c: float, scale: float) -> Float64:
    """Where (size,) the pixels of a target's row or column lie in the depth image."""
    in_color = (np.arange(size) - c_target) * (f / f_target) + c
    return np.asarray((in_color + 0.5) * scale - 0.5, np.float64)
