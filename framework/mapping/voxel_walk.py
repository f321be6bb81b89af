"""Reading the voxel grid along a ray: cell borders, single voxels, trilinear samples."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.mapping.voxel_grid import BLOCK_SIDE, UNSEEN, find_block


@njit(cache=True, nogil=True, forceinline=True)
def _leave_slab(z, start, d, inverse_d, size, inverse_size):
    """leave_cell() along one axis."""
    cell = np.floor((start + z * d) * inverse_size)
    if inverse_d > np.float32(0.0):  # not d: a ray along the slab has inverse_d huge and leaves it far ahead
        cell += np.float32(1.0)
    return (cell * size - start) * inverse_d


@njit(cache=True, nogil=True, forceinline=True)
def leave_cell(z, start, d, inverse_d, size, inverse_size):
    """The parameter at which the ray start + z * d leaves the grid cell of side `size` that it is in at z.

    `start`, `d` and `inverse_d` are triples; `inverse_d` is 1 / d, a huge number where d is 0.
    """
    exit_x = _leave_slab(z, start[0], d[0], inverse_d[0], size, inverse_size)
    exit_y = _leave_slab(z, start[1], d[1], inverse_d[1], size, inverse_size)
    exit_z = _leave_slab(z, start[2], d[2], inverse_d[2], size, inverse_size)
    return max(z, min(exit_x, min(exit_y, exit_z)))


@njit(cache=True, nogil=True, forceinline=True)
def inverses(d):
    """1 / d of a triple, with zeros taken for a hair, so that no ray divides by zero."""
    hair = np.float32(1e-12)
    x = d[0] if abs(d[0]) > hair else hair
    y = d[1] if abs(d[1]) > hair else hair
    z = d[2] if abs(d[2]) > hair else hair
    return np.float32(1.0) / x, np.float32(1.0) / y, np.float32(1.0) / z


@njit(cache=True, nogil=True, forceinline=True)
def voxel_number(i, j, k):
    """The place of voxel (i, j, k) within its block."""
    return ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)


@njit(cache=True, nogil=True, forceinline=True)
def trilinear(grid, x, y, z, key, region):
    """(distance m, valid, key, region) at the point (x, y, z), in voxels.

    Valid when all eight voxels around it were seen.
    """
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1.0)
    block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
    if block < 0:
        return np.float32(0.0), False, key, region
    total = np.float32(0.0)
    if (i & 7) < 7 and (j & 7) < 7 and (k & 7) < 7:
        tsdf = grid.tsdf[block]
        n = voxel_number(i, j, k)
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            stored = tsdf[n + a + BLOCK_SIDE * b + BLOCK_SIDE * BLOCK_SIDE * c]
            if stored == UNSEEN:
                return np.float32(0.0), False, key, region
            share = (fx if a else one - fx) * (fy if b else one - fy) * (fz if c else one - fz)
            total += share * np.float32(stored)
        return total * grid.tsdf_unit, True, key, region
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        block, key, region = find_block(grid, (i + a) >> 3, (j + b) >> 3, (k + c) >> 3, key, region)
        if block < 0:
            return np.float32(0.0), False, key, region
        stored = grid.tsdf[block, voxel_number(i + a, j + b, k + c)]
        if stored == UNSEEN:
            return np.float32(0.0), False, key, region
        share = (fx if a else one - fx) * (fy if b else one - fy) * (fz if c else one - fz)
        total += share * np.float32(stored)
    return total * grid.tsdf_unit, True, key, region


@njit(cache=True, nogil=True, forceinline=True)
def trilinear_color(grid, x, y, z, key, region, out):
    """The colour at (x, y, z), in voxels, into `out` (3,) uint8; voxels never seen do not count.

    Returns (key, region).
    """
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1.0)
    red = green = blue = total = np.float32(0.0)
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        block, key, region = find_block(grid, (i + a) >> 3, (j + b) >> 3, (k + c) >> 3, key, region)
        if block < 0:
            continue
        n = voxel_number(i + a, j + b, k + c)
        if grid.tsdf[block, n] == UNSEEN:
            continue
        share = (fx if a else one - fx) * (fy if b else one - fy) * (fz if c else one - fz)
        red += share * np.float32(grid.color[block, n, 0])
        green += share * np.float32(grid.color[block, n, 1])
        blue += share * np.float32(grid.color[block, n, 2])
        total += share
    if total > np.float32(0.0):
        scale = one / total
        out[0] = np.uint8(red * scale + np.float32(0.5))
        out[1] = np.uint8(green * scale + np.float32(0.5))
        out[2] = np.uint8(blue * scale + np.float32(0.5))
    return key, region


@njit(cache=True, nogil=True, forceinline=True)
def distance_at(grid, i, j, k, fallback, key, region):
    """(distance m, key, region) of voxel (i, j, k); `fallback` where it was never seen."""
    block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
    if block >= 0:
        stored = grid.tsdf[block, voxel_number(i, j, k)]
        if stored != UNSEEN:
            return np.float32(stored) * grid.tsdf_unit, key, region
    return fallback, key, region
