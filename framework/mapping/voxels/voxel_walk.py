"""Device functions that read the voxel grid: rays, cell borders, trilinear fields, and memory prefetch.

Functions for a whole image row work in passes that the compiler vectorizes. Look-ups branch and wait for memory, while
arithmetic does not. Therefore, one pass gathers the eight corners of each point with many concurrent loads. Another
pass does the arithmetic for eight pixels at a time. The last axis of their arrays is the pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from framework.mapping.voxels.voxel_grid_kernels import COLORED, NO_LOOK_UP, UNSEEN, device, find_block, unpack_color

CACHE_LINE = 64  # bytes
_READ, _L2, _DATA = 0, 2, 1  # arguments of llvm.prefetch: for reading, into the L2 cache, not instructions


@device
def ray_direction(view, u, v):
    """Return the world-frame ray (dx, dy, dz) of pixel (u, v), m per m of depth. `view` contains T_world_camera."""
    ray_x = (np.float32(u) - view.cx) / view.fx
    ray_y = (np.float32(v) - view.cy) / view.fy
    return (
        view.R[0, 0] * ray_x + view.R[0, 1] * ray_y + view.R[0, 2],
        view.R[1, 0] * ray_x + view.R[1, 1] * ray_y + view.R[1, 2],
        view.R[2, 0] * ray_x + view.R[2, 1] * ray_y + view.R[2, 2],
    )


@device
def seen_point(view, u, v, z):
    """Return the world point (x, y, z), m, of pixel (u, v) at depth z, m. `view` contains T_world_camera."""
    dx, dy, dz = ray_direction(view, u, v)
    return view.t[0] + z * dx, view.t[1] + z * dy, view.t[2] + z * dz


@device
def _leave_slab(z, start, d, inverse_d, size, inverse_size):
    """Return the parameter at which the ray leaves its cell along one axis; see leave_cell()."""
    cell = np.floor((start + z * d) * inverse_size)
    # not the sign of d: a ray parallel to the slab has a huge inverse_d and leaves the slab far away
    if inverse_d > np.float32(0.0):
        cell += np.float32(1.0)
    return (cell * size - start) * inverse_d


@device
def leave_cell(z, start, d, inverse_d, size, inverse_size):
    """Return the parameter at which the ray start + z * d leaves the grid cell that contains its point at z.

    Cells have the side `size`. `start`, `d` and `inverse_d` are triples. `inverse_d` is 1 / d, a huge number if d is 0.
    """
    exit_x = _leave_slab(z, start[0], d[0], inverse_d[0], size, inverse_size)
    exit_y = _leave_slab(z, start[1], d[1], inverse_d[1], size, inverse_size)
    exit_z = _leave_slab(z, start[2], d[2], inverse_d[2], size, inverse_size)
    return max(z, min(exit_x, min(exit_y, exit_z)))


@device
def inverses(d):
    """Return 1 / d for each entry of a triple; entries near 0 are replaced by a tiny value."""
    tiny = np.float32(1e-12)
    x = d[0] if abs(d[0]) > tiny else tiny
    y = d[1] if abs(d[1]) > tiny else tiny
    z = d[2] if abs(d[2]) > tiny else tiny
    return np.float32(1.0) / x, np.float32(1.0) / y, np.float32(1.0) / z


@device
def voxel_number(i, j, k):
    """Return the index of voxel (i, j, k) in its block."""
    return ((k & 7) * 8 + (j & 7)) * 8 + (i & 7)


@device
def _of_neighbor(grid, values, block, neighbor, n, missing):
    """Return entry n of values (B, 512) of a block's neighbor, or `missing` if the neighbor is absent."""
    there = grid.neighbors[np.uint32(block), np.uint32(neighbor)]
    return values[np.uint32(there), np.uint32(n)] if there >= 0 else missing


@device
def corners(grid, values, block, i, j, k, missing):
    """Return the `values` (B, 512) of the eight voxels (i, j, k) + {0, 1}^3, x fastest; `block` contains (i, j, k)."""
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
    # the carry of a coordinate into the next block is the bit of this coordinate in the neighbor's index
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
    """Return (value, d/dx, d/dy, d/dz) at fractions (fx, fy, fz) of a voxel between eight corners `s`, x fastest.

    The derivatives are per voxel.
    """
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
    """Return True if all eight voxels with the stored distances `s` were observed."""
    return min(min(min(s[0], s[1]), min(s[2], s[3])), min(min(s[4], s[5]), min(s[6], s[7]))) != UNSEEN


@device
def trilinear(grid, block, x, y, z):
    """Return (value, d/dx, d/dy, d/dz, valid): the distance and its gradient at (x, y, z), voxels, in stored units.

    `block` contains the voxel at the floor of the point. The result is valid if all eight voxels around the point were
    observed.
    """
    i, j, k = np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(z))
    s = corners(grid, grid.tsdf, block, i, j, k, np.int16(UNSEEN))
    value, dx, dy, dz = interpolate(s, x - np.float32(i), y - np.float32(j), z - np.float32(k))
    return value, dx, dy, dz, all_seen(s)


@device
def _add_color(red, green, blue, total, packed, weight):
    """Return the sums after adding a packed color and its weight. A voxel without a color adds nothing."""
    weight = weight if packed & COLORED else np.float32(0.0)
    r, g, b = unpack_color(packed)
    return red + weight * r, green + weight * g, blue + weight * b, total + weight


@device
def blend(p, x1, y1, z1):
    """Return (red, green, blue) in [0, 255] at fractions (x1, y1, z1) of a voxel between eight packed colors.

    Voxels without a color are ignored.
    """
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


@intrinsic
def prefetch_line(_typing_context: Any, array: Any, offset: Any) -> Any:
    """Prefetch the cache line at `offset` bytes after the first element of an array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte, int32 = ir.IntType(8), ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(builder.bitcast(data, byte.as_pointer()), [arguments[1]])
        function_type = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), int32, int32, int32])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0i8")
        builder.call(function, [address, int32(_READ), int32(_L2), int32(_DATA)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@device
def prefetch_element(array, row, column):
    """Prefetch array[row, column]."""
    prefetch_line(array, np.int64(row) * array.strides[0] + np.int64(column) * array.strides[1])


@device
def prefetch_row(array, row):
    """Prefetch array[row] if the row exists."""
    if 0 <= row < array.shape[0]:
        bytes_a_row = array.itemsize * (array.size // array.shape[0])
        for line in range(0, bytes_a_row, CACHE_LINE):
            prefetch_line(array, row * bytes_a_row + line)


@device
def directions(view, scale, v):
    """Return the world-frame ray of pixel (0, v), voxels per m of depth, and its change per pixel.

    `scale` is in voxels per m, and `view` contains T_world_camera.
    """
    x, y, z = ray_direction(view, 0, v)
    # not the difference of two rays, because its rounding error would accumulate along the row
    change = scale / view.fx
    return (x * scale, y * scale, z * scale), (view.R[0, 0] * change, view.R[1, 0] * change, view.R[2, 0] * change)


@device
def points_of_row(view, scale, v, depth, points):
    """Fill `points` (3, W), world frame, in voxels, with the points of image row v at `depth` (W,), m.

    `scale` is in voxels per m, and `view` contains T_world_camera.
    """
    origin, change = directions(view, scale, v)
    tx, ty, tz = view.t[0] * scale, view.t[1] * scale, view.t[2] * scale
    for n in range(depth.shape[0]):
        u = np.float32(np.int32(n))
        z = depth[n]
        points[0, n] = tx + z * (origin[0] + u * change[0])
        points[1, n] = ty + z * (origin[1] + u * change[1])
        points[2, n] = tz + z * (origin[2] + u * change[2])


@device
def gather_corners(grid, values, depth, points, missing, found):
    """Fill found (8, W) with `values` (B, 512) of the eight voxels around each point (3, W).

    Values are `missing` where no block is allocated or the pixel has no depth.
    """
    key, region = NO_LOOK_UP
    for n in range(depth.shape[0]):
        s = missing, missing, missing, missing, missing, missing, missing, missing
        if depth[n] > np.float32(0.0):
            i = np.int32(np.floor(points[0, n]))
            j = np.int32(np.floor(points[1, n]))
            k = np.int32(np.floor(points[2, n]))
            block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
            if block >= 0:
                s = corners(grid, values, block, i, j, k, missing)
        found[0, n] = s[0]
        found[1, n] = s[1]
        found[2, n] = s[2]
        found[3, n] = s[3]
        found[4, n] = s[4]
        found[5, n] = s[5]
        found[6, n] = s[6]
        found[7, n] = s[7]


@device
def step_to_surface(view, scale, v, found, points, converged, reach, limits, depth, normals):
    """Move each depth (W,), m, by one Newton step along its ray to the zero of the trilinear field.

    `found` (8, W) holds the distances around `points` (3, W). A depth becomes 0 if the field is unknown, if it does not
    decrease along the ray, or if the zero is farther than `reach` voxels or beyond `limits` (W,), m. A depth is negated
    if the step is longer than `converged` voxels. Sets normals (3, W) to the normalized gradients.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    origin, change = directions(view, scale, v)
    for n in range(depth.shape[0]):
        u = np.float32(np.int32(n))
        dx, dy, dz = origin[0] + u * change[0], origin[1] + u * change[1], origin[2] + u * change[2]
        x, y, z = points[0, n], points[1, n], points[2, n]
        s = found[0, n], found[1, n], found[2, n], found[3, n], found[4, n], found[5, n], found[6, n], found[7, n]
        value, nx, ny, nz = interpolate(s, x - np.floor(x), y - np.floor(y), z - np.floor(z))
        slope = nx * dx + ny * dy + nz * dz
        step = -value / slope
        norm = one / np.sqrt(nx * nx + ny * ny + nz * nz)
        normals[0, n] = nx * norm
        normals[1, n] = ny * norm
        normals[2, n] = nz * norm
        after = depth[n] + step
        length = abs(step) * np.sqrt(dx * dx + dy * dy + dz * dz)
        good = all_seen(s) & (slope < zero) & (length < reach) & (after > zero) & (after < limits[n])
        after = after if length < converged else -after
        depth[n] = after if good else zero


@device
def blend_colors(found, points, color):
    """Fill color (W, 3), RGB, by interpolation between the packed colors `found` (8, W) around `points` (3, W).

    `points`, in voxels, is overwritten.
    """
    half = np.float32(0.5)
    for n in range(points.shape[1]):
        x, y, z = points[0, n], points[1, n], points[2, n]
        p = found[0, n], found[1, n], found[2, n], found[3, n], found[4, n], found[5, n], found[6, n], found[7, n]
        red, green, blue = blend(p, x - np.floor(x), y - np.floor(y), z - np.floor(z))
        points[0, n], points[1, n], points[2, n] = red + half, green + half, blue + half
    for n in range(points.shape[1]):
        color[n, 0], color[n, 1], color[n, 2] = np.uint8(points[0, n]), np.uint8(points[1, n]), np.uint8(points[2, n])
