"""Which blocks of the map a camera can see, and where: boxes along the camera's axes, never too tight."""

from __future__ import annotations

import numpy as np

from framework.data import Camera, Float64, Int32
from framework.geometry import inverse


def boxes_in_view(camera: Camera, T_world_camera: Float64, low: Float64, high: Float64, near: float) -> Int32:
    """(N, 4) u0, v0, u1, v1: the pixels, from the first to before the last, that can see boxes of the world.

    `low` and `high` (N, 3) m are the boxes' corners, `near` the depth (m) where sight begins. A box out of view has
    u1 <= u0 or v1 <= v0.
    """
    T_camera_world = inverse(T_world_camera)
    center = (low + high) / 2 @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    half = (high - low) / 2 @ np.abs(T_camera_world[:3, :3]).T
    left, top, z0 = (center - half).T
    right, bottom, z1 = (center + half).T
    z0, z1 = np.maximum(z0, near), np.maximum(z1, near)
    # rays diverge, so a side is seen farthest out where it is nearest, or farthest away on the other side of the axis
    first = np.stack([camera.fx * np.minimum(left / z0, left / z1), camera.fy * np.minimum(top / z0, top / z1)])
    last = np.stack([camera.fx * np.maximum(right / z0, right / z1), camera.fy * np.maximum(bottom / z0, bottom / z1)])
    middle, size = np.array([[camera.cx], [camera.cy]]), np.array([[camera.width], [camera.height]])
    first = np.clip(np.floor(first + middle), 0, size)
    last = np.clip(np.ceil(last + middle) + 1, 0, size)
    last[:, z1 <= near] = 0
    return np.concatenate([first, last]).T.astype(np.int32)
