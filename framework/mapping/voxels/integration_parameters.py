"""Camera and depth sensor parameters for the kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Camera, Float32, Float64

BOUNDS = {  # bounds of voxel_size, m, and of the fields of Sensor, in their units
    "voxel_size": (1e-4, 1.0),
    "truncation": (1e-4, 100.0),
    "truncation_slope": (0.0, 1.0),
    "min_depth": (1e-3, 100.0),
    "max_depth": (1e-3, 1000.0),
    "max_weight": (1.0, 255.0),
    "full_weight_depth": (1e-3, 1000.0),
}


class Sensor(NamedTuple):
    """Parameters for integrating depth images."""

    truncation: np.float32  # truncation distance at depth 0, m
    truncation_slope: np.float32  # increase of the truncation distance with depth, m per m
    min_depth: np.float32  # minimum depth of integrated readings, m
    max_depth: np.float32  # maximum depth of integrated readings, m
    max_weight: np.float32  # maximum weight, in observations
    full_weight_depth: np.float32  # m; a depth reading has weight min(1, (full_weight_depth / depth)^2)

    @property
    def max_truncation(self) -> float:
        """Maximum truncation distance, m."""
        return float(self.truncation + self.truncation_slope * self.max_depth)

    @property
    def depth_range(self) -> tuple[float, float]:
        """Minimum and maximum depth of integrated readings, m."""
        return float(self.min_depth), float(self.max_depth)


class Pinhole(NamedTuple):
    """A camera and its pose in single precision.

    The intrinsics are in px.
    """

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    R: Float32  # (3, 3) rotation of the pose
    t: Float32  # (3,) m, translation of the pose


def pinhole(camera: Camera, T: Float64) -> Pinhole:
    """Return the pinhole camera with the given pose (4, 4).

    Depending on the kernel, the pose is T_world_camera or its inverse.
    """
    return Pinhole(
        fx=np.float32(camera.fx),
        fy=np.float32(camera.fy),
        cx=np.float32(camera.cx),
        cy=np.float32(camera.cy),
        R=np.ascontiguousarray(T[:3, :3], np.float32),
        t=np.ascontiguousarray(T[:3, 3], np.float32),
    )
