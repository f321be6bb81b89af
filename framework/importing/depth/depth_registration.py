"""Depth of one camera as another one beside it sees it: the nearest reading in each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Camera, Float32, Float64
from framework.importing.depth.depth_registration_kernels import move_readings

FINEST = 0.9  # of the depth camera's focal length in px: at its own, rounding would leave lines without readings


@dataclass(frozen=True)
class DepthRegistration:
    """Where the colour camera sees what the depth camera measures."""

    depth: Camera
    color: Camera
    T_color_depth: Float64  # (4, 4)

    @property
    def target(self) -> Camera:
        """The colour camera, in the resolution that depth has readings for."""
        return self.color.scaled(min(1.0, FINEST * min(self.depth.fx / self.color.fx, self.depth.fy / self.color.fy)))

    def apply(self, depth: Float32) -> Float32:
        """Depth (H, W) m of `target` from depth (h, w) m of the depth camera, 0 = no reading."""
        registered = np.zeros(self.target.shape, np.float32)
        move_readings(depth, self.depth.K, self.target.K, self.T_color_depth, registered)
        return registered
