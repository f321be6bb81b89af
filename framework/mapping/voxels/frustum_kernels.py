"""Kernels that find the blocks in a camera's view frustum."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.mapping.voxels.voxel_grid import REGION_BLOCKS, REGION_SIDE
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, device


@device
def _extent(camera, size, margin):
    """Half the sides, along the camera's axes, of the box around a cube of the world; m."""
    half = np.float32(0.5) * size
    return (
        half * (abs(camera.R[0, 0]) + abs(camera.R[0, 1]) + abs(camera.R[0, 2])) + margin,
        half * (abs(camera.R[1, 0]) + abs(camera.R[1, 1]) + abs(camera.R[1, 2])) + margin,
        half * (abs(camera.R[2, 0]) + abs(camera.R[2, 1]) + abs(camera.R[2, 2])) + margin,
    )


@device
def _bounds(camera, x, y, z, extent, near, far, shape):
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


@njit(cache=True, nogil=True, error_model="numpy")
def solid_blocks_in_view(grid, region_count, block_count, camera, near, far, shape):
    """(blocks (N,), depths (N, 2) m, pixels (N, 4) u0, u1, v0, v1 inclusive) of the blocks that hold a surface.

    `camera` holds T_camera_world. The cost is a test a region of the map (0.26 m^3 at 1 cm voxels) and one a block of
    those in view.
    """
    blocks = np.empty(block_count, np.int32)
    depths = np.empty((block_count, 2), np.float32)
    pixels = np.empty((block_count, 4), np.int32)
    voxel = grid.voxel_size
    block_size = np.float32(BLOCK_SIDE) * voxel
    region_size = np.float32(REGION_SIDE) * block_size
    block_extent = _extent(camera, block_size, voxel)
    region_extent = _extent(camera, region_size, voxel)
    half = np.float32(0.5)
    found = 0
    for region in range(region_count):
        x = (np.float32(grid.region_coords[region, 0]) + half) * region_size
        y = (np.float32(grid.region_coords[region, 1]) + half) * region_size
        z = (np.float32(grid.region_coords[region, 2]) + half) * region_size
        if not _bounds(camera, x, y, z, region_extent, near, far, shape)[0]:
            continue
        for child in range(REGION_BLOCKS):
            block = grid.region_blocks[region, child]
            if block < 0 or not grid.solid[block]:
                continue
            x = (np.float32(grid.block_coords[block, 0]) + half) * block_size
            y = (np.float32(grid.block_coords[block, 1]) + half) * block_size
            z = (np.float32(grid.block_coords[block, 2]) + half) * block_size
            visible, z0, z1, u0, u1, v0, v1 = _bounds(camera, x, y, z, block_extent, near, far, shape)
            if visible:
                blocks[found] = block
                depths[found, 0], depths[found, 1] = z0, z1
                pixels[found, 0], pixels[found, 1], pixels[found, 2], pixels[found, 3] = u0, u1, v0, v1
                found += 1
    return blocks[:found], depths[:found], pixels[:found]
