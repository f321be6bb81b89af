"""Depth of one camera as another one beside it sees it: the nearest reading in each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64

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
        _move(depth, self.depth.K, self.target.K, self.T_color_depth, registered)
        return registered


@njit(cache=True, nogil=True)
def _move(depth: Float32, K: Float64, K_target: Float64, T: Float64, registered: Float32) -> None:
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
