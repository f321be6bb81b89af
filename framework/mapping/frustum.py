"""Which part of an image a block of the map can cover: boxes along the camera's axes, never too tight."""

from __future__ import annotations

import numpy as np

from framework.mapping.voxel_grid import device


@device
def extent(camera, size, margin):
    """Half the sides, along the camera's axes, of the box around a cube of the world; m."""
    half = np.float32(0.5) * size
    return (
        half * (abs(camera.R[0, 0]) + abs(camera.R[0, 1]) + abs(camera.R[0, 2])) + margin,
        half * (abs(camera.R[1, 0]) + abs(camera.R[1, 1]) + abs(camera.R[1, 2])) + margin,
        half * (abs(camera.R[2, 0]) + abs(camera.R[2, 1]) + abs(camera.R[2, 2])) + margin,
    )


@device
def bounds(camera, x, y, z, extent, near, far, shape):
    """(visible, z0, z1, u0, u1, v0, v1): depths (m) and pixels, inclusive, of the box around a point of the world."""
    height, width = shape
    pz = camera.R[2, 0] * x + camera.R[2, 1] * y + camera.R[2, 2] * z + camera.t[2]
    z0, z1 = max(pz - extent[2], near), min(pz + extent[2], far)
    if z0 > z1:
        return False, z0, z1, 0, 0, 0, 0
    px = camera.R[0, 0] * x + camera.R[0, 1] * y + camera.R[0, 2] * z + camera.t[0]
    py = camera.R[1, 0] * x + camera.R[1, 1] * y + camera.R[1, 2] * z + camera.t[1]
    left, right = px - extent[0], px + extent[0]
    top, bottom = py - extent[1], py + extent[1]
    u0 = camera.fx * min(left / z0, left / z1) + camera.cx
    u1 = camera.fx * max(right / z0, right / z1) + camera.cx
    v0 = camera.fy * min(top / z0, top / z1) + camera.cy
    v1 = camera.fy * max(bottom / z0, bottom / z1) + camera.cy
    if u1 < 0 or v1 < 0 or u0 > width - 1 or v0 > height - 1:
        return False, z0, z1, 0, 0, 0, 0
    u0, v0 = max(u0, np.float32(0.0)), max(v0, np.float32(0.0))
    u1, v1 = min(u1, np.float32(width - 2)), min(v1, np.float32(height - 2))
    return True, z0, z1, int(u0), int(u1) + 1, int(v0), int(v1) + 1
