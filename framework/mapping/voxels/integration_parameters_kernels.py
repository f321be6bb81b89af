"""Kernels of integration_parameters.py."""

from __future__ import annotations

import numpy as np

from framework.mapping.voxels.voxel_grid_kernels import device


@device
def ray_direction(view, u, v):
    """(dx, dy, dz), in the world, m for each m of depth: the ray through pixel (u, v). `view` holds T_world_camera."""
    ray_x = (np.float32(u) - view.cx) / view.fx
    ray_y = (np.float32(v) - view.cy) / view.fy
    return (
        view.R[0, 0] * ray_x + view.R[0, 1] * ray_y + view.R[0, 2],
        view.R[1, 0] * ray_x + view.R[1, 1] * ray_y + view.R[1, 2],
        view.R[2, 0] * ray_x + view.R[2, 1] * ray_y + view.R[2, 2],
    )


@device
def seen_point(view, u, v, z):
    """(x, y, z), in the world, m: the point that pixel (u, v) sees at depth z (m). `view` holds T_world_camera."""
    dx, dy, dz = ray_direction(view, u, v)
    return view.t[0] + z * dx, view.t[1] + z * dy, view.t[2] + z * dz
