"""Resampling of depth from another camera or a lower resolution to the pixels of a color image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Camera, Float32, Float64, UInt8
from framework.importing.depth_resampling_kernels import move_readings, upsample

# maximum ratio of the focal lengths of the target and depth cameras; 1.0 would leave rows and columns without readings
FINEST = 0.9


@dataclass(frozen=True)
class DepthRegistration:
    """Registration of depth to a color camera with another pose.

    If several readings project to a pixel, the nearest reading is kept.
    """

    depth: Camera
    color: Camera
    T_color_depth: Float64  # (4, 4)

    @property
    def target(self) -> Camera:
        """The color camera, scaled to at most FINEST times the resolution of the depth camera."""
        return self.color.scaled(min(1.0, FINEST * min(self.depth.fx / self.color.fx, self.depth.fy / self.color.fy)))

    def apply(self, depth: Float32) -> Float32:
        """Return the depth (H, W) of `target` in m from the depth (h, w) of the depth camera in m, 0 = no reading."""
        registered = np.zeros(self.target.shape, np.float32)
        move_readings(depth, self.depth.K, self.target.K, self.T_color_depth, registered)
        return registered


def upsampled(depth: Float32, color: UInt8, camera: Camera, target: Camera, target_color: UInt8) -> Float32:
    """Return the depth (H, W), m, of the camera `target`, resampled from `depth` (h, w), m; 0 = no reading.

    `color` and `target_color` are the RGB images of `camera` and `target`, which have the same pose.
    `depth` has the field of view of `camera`. If the four depth readings around a pixel belong to one surface, their
    inverses are interpolated, which is exact for a plane. Otherwise, the pixel gets the reading with the largest
    weight, which decreases with the distance in the image and in color. No depth therefore lies between two surfaces.
    The weights are those of joint bilateral upsampling (Kopf et al., SIGGRAPH 2007). If the nearest pixel of `depth`
    has no reading, the result has none either.
    """
    height, width = depth.shape
    guide = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    u = _coordinates(target.width, target.fx, target.cx, camera.fx, camera.cx, width / camera.width)
    v = _coordinates(target.height, target.fy, target.cy, camera.fy, camera.cy, height / camera.height)
    found = np.zeros(target.shape, np.float32)
    upsample(depth, guide, u, v, target_color, found)
    return found


def _coordinates(size: int, f_target: float, c_target: float, f: float, c: float, scale: float) -> Float64:
    """Return the coordinates (size,), px, in the depth image for the pixels of a row or column of the target.

    `f_target`, `c_target`, `f` and `c` are the focal lengths and principal points of the target and color cameras, px.
    `scale` is the size of the depth image relative to the color image.
    """
    in_color = (np.arange(size) - c_target) * (f / f_target) + c
    return np.asarray((in_color + 0.5) * scale - 0.5, np.float64)
