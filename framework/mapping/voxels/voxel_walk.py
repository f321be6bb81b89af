"""Reading the voxel grid along a ray: cell borders and the trilinear fields between voxels."""

from __future__ import annotations

import numpy as np

from framework.mapping.voxels.voxel_grid_kernels import COLORED, UNSEEN, device, unpack_color


@device
def _leave_slab(z, start, d, inverse_d, size, inverse_size):
    """leave_cell() along one axis."""
    cell = np.floor((start + z * d) * inverse_size)
    if inverse_d > np.float32(0.0):  # not d: a ray along the slab has inverse_d huge and leaves it far ahead
        cell += np.float32(1.0)
    return (cell * size - start) * inverse_d


@device
def leave_cell(z, start, d, inverse_d, size, inverse_size):
    """The parameter at which the ray start + z * d leaves the grid cell of side `size` that it is in at z.

    `start`, `d` and `inverse_d` are triples; `inverse_d` is 1 / d, a huge number where d is 0.
    """
    exit_x = _leave_slab(z, start[0], d[0], inverse_d[0], size, inverse_size)
    exit_y = _leave_slab(z, start[1], d[1], inverse_d[1], size, inverse_size)
    exit_z = _leave_slab(z, start[2], d[2], inverse_d[2], size, inverse_size)
    return max(z, min(exit_x, min(exit_y, exit_z)))


@device
def inverses(d):
    """1 / d of a triple, with zeros taken for a hair, so that no ray divides by zero."""
    hair = np.float32(1e-12)
    x = d[0] if abs(d[0]) > hair else hair
    y = d[1] if abs(d[1]) > hair else hair
    z = d[2] if abs(d[2]) > hair else hair
    return np.float32(1.0) / x, np.float32(1.0) / y, np.float32(1.0) / z


@device
def voxel_number(i, j, k):
    """The place of voxel (i, j, k) within its block."""
    return ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)


@device
def _of_neighbor(grid, values, block, neighbor, n, missing):
    """What `values` (B, 512) holds for voxel n of a block's neighbor, `missing` where there is none."""
    there = grid.neighbors[np.uint32(block), np.uint32(neighbor)]
    return values[np.uint32(there), np.uint32(n)] if there >= 0 else missing


@device
def corners(grid, values, block, i, j, k, missing):
    """What `values` (B, 512) holds for the eight voxels (i, j, k) + {0, 1}^3, x fastest; `block` holds (i, j, k)."""
    x, y, z = i & 7, j & 7, k & 7
    n = (z * 8 + y) * 8 + x
    here = np.uint32(block)
    if max(x, max(y, z)) < 7:
        return (
            values[here, np.uint32(n)],
            values[here, np.uint32(n + 1)],
            values[here, np.uint32(n + 8)],
            values[here, np.uint32(n + 9)],
            values[here, np.uint32(n + 64)],
            values[here, np.uint32(n + 65)],
            values[here, np.uint32(n + 72)],
            values[here, np.uint32(n + 73)],
        )
    # the carry of each coordinate into the next block is that coordinate's bit of the neighbor's number
    next_x, next_y, next_z = (x + 1) & 7, ((y + 1) & 7) * 8, ((z + 1) & 7) * 64
    over_x, over_y, over_z = (x + 1) >> 3, ((y + 1) >> 3) << 1, ((z + 1) >> 3) << 2
    y *= 8
    z *= 64
    return (
        values[here, np.uint32(n)],
        _of_neighbor(grid, values, block, over_x, z + y + next_x, missing),
        _of_neighbor(grid, values, block, over_y, z + next_y + x, missing),
        _of_neighbor(grid, values, block, over_y | over_x, z + next_y + next_x, missing),
        _of_neighbor(grid, values, block, over_z, next_z + y + x, missing),
        _of_neighbor(grid, values, block, over_z | over_x, next_z + y + next_x, missing),
        _of_neighbor(grid, values, block, over_z | over_y, next_z + next_y + x, missing),
        _of_neighbor(grid, values, block, over_z | over_y | over_x, next_z + next_y + next_x, missing),
    )


@device
def interpolate(s, fx, fy, fz):
    """(value, d/dx, d/dy, d/dz) between eight corners, x fastest, at the fractions (fx, fy, fz) of a voxel."""
    x00, x10, x01, x11 = np.float32(s[0]), np.float32(s[2]), np.float32(s[4]), np.float32(s[6])
    dx00, dx10 = np.float32(s[1]) - x00, np.float32(s[3]) - x10
    dx01, dx11 = np.float32(s[5]) - x01, np.float32(s[7]) - x11
    x00 += fx * dx00
    x10 += fx * dx10
    x01 += fx * dx01
    x11 += fx * dx11
    dy0, dy1 = x10 - x00, x11 - x01
    y0, y1 = x00 + fy * dy0, x01 + fy * dy1
    dx0, dx1 = dx00 + fy * (dx10 - dx00), dx01 + fy * (dx11 - dx01)
    return y0 + fz * (y1 - y0), dx0 + fz * (dx1 - dx0), dy0 + fz * (dy1 - dy0), y1 - y0


@device
def all_seen(s):
    """Whether eight corners' distances were all seen."""
    return min(min(min(s[0], s[1]), min(s[2], s[3])), min(min(s[4], s[5]), min(s[6], s[7]))) != UNSEEN


@device
def trilinear(grid, block, x, y, z):
    """(value, d/dx, d/dy, d/dz, valid): the field of stored distances at (x, y, z), in voxels, and its gradient.

    `block` holds the voxel at the floor of the point. Valid when all eight voxels around it were seen.
    """
    i, j, k = np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(z))
    s = corners(grid, grid.tsdf, block, i, j, k, np.int16(UNSEEN))
    value, dx, dy, dz = interpolate(s, x - np.float32(i), y - np.float32(j), z - np.float32(k))
    return value, dx, dy, dz, all_seen(s)


@device
def _add_color(red, green, blue, total, packed, share):
    """Adds a packed colour with its share; a voxel without a colour has no say."""
    share = share if packed & COLORED else np.float32(0.0)
    r, g, b = unpack_color(packed)
    return red + share * r, green + share * g, blue + share * b, total + share


@device
def blend(p, x1, y1, z1):
    """(red, green, blue) at the fractions (x1, y1, z1) between eight packed colours, of those that are colours."""
    one, zero = np.float32(1.0), np.float32(0.0)
    x0, y0, z0 = one - x1, one - y1, one - z1
    r, g, b, total = _add_color(zero, zero, zero, zero, p[0], x0 * y0 * z0)
    r, g, b, total = _add_color(r, g, b, total, p[1], x1 * y0 * z0)
    r, g, b, total = _add_color(r, g, b, total, p[2], x0 * y1 * z0)
    r, g, b, total = _add_color(r, g, b, total, p[3], x1 * y1 * z0)
    r, g, b, total = _add_color(r, g, b, total, p[4], x0 * y0 * z1)
    r, g, b, total = _add_color(r, g, b, total, p[5], x1 * y0 * z1)
    r, g, b, total = _add_color(r, g, b, total, p[6], x0 * y1 * z1)
    r, g, b, total = _add_color(r, g, b, total, p[7], x1 * y1 * z1)
    scale = np.float32(0.25) / max(total, np.float32(1e-6))
    return r * scale, g * scale, b * scale
