"""Resampling of depth images to the pixels of a color camera."""

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
    """Registration of depth images to a color camera with another pose."""

    depth: Camera
    color: Camera
    T_color_depth: Float64  # (4, 4)

    @property
    def target(self) -> Camera:
        """The color camera, scaled to at most FINEST times the resolution of the depth camera."""
        return self.color.scaled(min(1.0, FINEST * min(self.depth.fx / self.color.fx, self.depth.fy / self.color.fy)))

    def apply(self, depth: Float32) -> Float32:
        """Register a depth image (h, w), m, and return the depth (H, W), m, of the camera `target`."""
        registered = np.zeros(self.target.shape, np.float32)
        move_readings(depth, self.depth.K, self.target.K, self.T_color_depth, registered)
        return registered


def upsampled(depth: Float32, color: UInt8, camera: Camera, target: Camera, target_color: UInt8) -> Float32:
    """Resample a depth image to the resolution of a color image, guided by the colors.

    Depth is interpolated if the four readings around a pixel belong to one surface. Otherwise, the pixel gets the
    reading with the largest weight, so that no depth lies between two surfaces. The weights are those of joint
    bilateral upsampling (Kopf et al., SIGGRAPH 2007). Pixels whose nearest reading is missing get 0.

    Args:
        depth: The depth (h, w), m, with the field of view of `camera`, 0 = no reading.
        color: The color image of `camera`, RGB.
        camera: The camera of the recording.
        target: The output camera, with the same pose.
        target_color: The color image (H, W, 3) of `target`, RGB.

    Returns:
        The depth (H, W), m, of `target`.
    """
    height, width = depth.shape
    guide = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    u = _coordinates(target.width, target.fx, target.cx, camera.fx, camera.cx, width / camera.width)
    v = _coordinates(target.height, target.fy, target.cy, camera.fy, camera.cy, height / camera.height)
    found = np.zeros(target.shape, np.float32)
    upsample(depth, guide, u, v, target_color, found)
    return found


def _coordinates(size: int, f_target: float, c_target: float, f: float, c: float, scale: float) -> Float64:
    """Return the coordinates (size,), px, in the depth image for a row or column of the target.

    Args:
        size: The number of pixels.
        f_target: The focal length of the target camera, px.
        c_target: The principal point of the target camera, px.
        f: The focal length of the color camera, px.
        c: The principal point of the color camera, px.
        scale: The size of the depth image relative to the color image.
    """
    in_color = (np.arange(size) - c_target) * (f / f_target) + c
    return np.asarray((in_color + 0.5) * scale - 0.5, np.float64)
