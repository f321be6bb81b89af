"""Device functions for rays, trilinear interpolation and prefetching in the voxel grid.

Functions for a whole image row first gather the eight corners of every point, and then do the arithmetic. The compiler
can vectorize the arithmetic because it does not branch. The last axis of these arrays is the pixel.
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
    """Return the world-frame ray (dx, dy, dz) of a pixel, scaled to unit depth.

    The pose in `view` is T_world_camera.
    """
    ray_x = (np.float32(u) - view.cx) / view.fx
    ray_y = (np.float32(v) - view.cy) / view.fy
    return (
        view.R[0, 0] * ray_x + view.R[0, 1] * ray_y + view.R[0, 2],
        view.R[1, 0] * ray_x + view.R[1, 1] * ray_y + view.R[1, 2],
        view.R[2, 0] * ray_x + view.R[2, 1] * ray_y + view.R[2, 2],
    )


@device
def seen_point(view, u, v, z):
    """Return the world point (x, y, z), m, of pixel (u, v) at depth z, m.

    The pose in `view` is T_world_camera.
    """
    dx, dy, dz = ray_direction(view, u, v)
    return view.t[0] + z * dx, view.t[1] + z * dy, view.t[2] + z * dz


@device
def _leave_slab(z, start, d, inverse_d, size, inverse_size):
    """Return the ray parameter at which the ray leaves its cell along one axis."""
    cell = np.floor((start + z * d) * inverse_size)
    # not the sign of d: a ray parallel to the slab has a huge inverse_d and leaves the slab far away
    if inverse_d > np.float32(0.0):
        cell += np.float32(1.0)
    return (cell * size - start) * inverse_d


@device
def leave_cell(z, start, d, inverse_d, size, inverse_size):
    """Return the ray parameter at which a ray leaves the grid cell that contains it at z.

    Args:
        z: The ray parameter of a point in the cell.
        start: The origin of the ray, a triple.
        d: The direction of the ray, a triple.
        inverse_d: The inverse of each component of `d`; see inverses().
        size: The side of a cell.
        inverse_size: The inverse of `size`.
    """
    exit_x = _leave_slab(z, start[0], d[0], inverse_d[0], size, inverse_size)
    exit_y = _leave_slab(z, start[1], d[1], inverse_d[1], size, inverse_size)
    exit_z = _leave_slab(z, start[2], d[2], inverse_d[2], size, inverse_size)
    return max(z, min(exit_x, min(exit_y, exit_z)))


@device
def inverses(d):
    """Return the inverse of each entry of a triple.

    Entries near 0 are replaced by a tiny value.
    """
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
    """Return entry n of the values of a neighboring block, or `missing` if the block is not allocated."""
    there = grid.neighbors[np.uint32(block), np.uint32(neighbor)]
    return values[np.uint32(there), np.uint32(n)] if there >= 0 else missing


@device
def corners(grid, values, block, i, j, k, missing):
    """Return the values of the eight voxels at the corners of a cell, x fastest.

    Args:
        grid: The voxel grid.
        values: One value (B, 512) per voxel.
        block: The block that contains voxel (i, j, k).
        i: The first index of the first corner.
        j: The second index of the first corner.
        k: The third index of the first corner.
        missing: The value of voxels in blocks that are not allocated.
    """
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
    # neighbor index: bit 0, 1 or 2 is set if x, y or z is in the next block
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
    """Return the trilinear interpolation between eight corners, and its three derivatives per voxel.

    The corners `s` are ordered with x fastest. The position (fx, fy, fz) is a fraction of a voxel.
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
    """Return True if all eight voxels were observed, given their stored distances."""
    return min(min(min(s[0], s[1]), min(s[2], s[3])), min(min(s[4], s[5]), min(s[6], s[7]))) != UNSEEN


@device
def trilinear(grid, block, x, y, z):
    """Return (distance, d/dx, d/dy, d/dz, valid) at a point, in stored units.

    The point is in voxels, and `block` contains the voxel at its floor. The result is valid if all eight voxels around
    the point were observed.
    """
    i, j, k = np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(z))
    s = corners(grid, grid.tsdf, block, i, j, k, np.int16(UNSEEN))
    value, dx, dy, dz = interpolate(s, x - np.float32(i), y - np.float32(j), z - np.float32(k))
    return value, dx, dy, dz, all_seen(s)


@device
def _add_color(red, green, blue, total, packed, weight):
    """Add a packed color and its weight to the sums, unless the voxel has no color."""
    weight = weight if packed & COLORED else np.float32(0.0)
    r, g, b = unpack_color(packed)
    return red + weight * r, green + weight * g, blue + weight * b, total + weight


@device
def blend(p, x1, y1, z1):
    """Return the trilinear interpolation (red, green, blue), in [0, 255], between eight packed colors.

    The position (x1, y1, z1) is a fraction of a voxel. Voxels without a color are ignored.
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
    """Prefetch the cache line that contains the byte at `offset` in an array."""

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
    """Return the world-frame ray of pixel (0, v) and its change per pixel, in voxels per m of depth.

    The scale is in voxels per m. The pose in `view` is T_world_camera.
    """
    x, y, z = ray_direction(view, 0, v)
    # not the difference of two rays, because its rounding error would accumulate along the row
    change = scale / view.fx
    return (x * scale, y * scale, z * scale), (view.R[0, 0] * change, view.R[1, 0] * change, view.R[2, 0] * change)


@device
def points_of_row(view, scale, v, depth, points):
    """Compute the world points of an image row, in voxels, from its depths.

    Args:
        view: The camera with the pose T_world_camera.
        scale: The number of voxels per m.
        v: The image row.
        depth: The depths (W,), m.
        points: The output (3, W).
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
    """Gather the values of the eight voxels around each point of an image row.

    Args:
        grid: The voxel grid.
        values: One value (B, 512) per voxel.
        depth: The depths (W,) of the pixels, 0 = no depth.
        points: The points (3, W), in voxels.
        missing: The value if the block is not allocated or the pixel has no depth.
        found: The output (8, W).
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
    """Move the depths of an image row by one Newton step toward the surface.

    A depth becomes 0 if the field is unknown or does not decrease along the ray. The depth also becomes 0 if the
    surface is too far away. A depth that has not converged is negated.

    Args:
        view: The camera with the pose T_world_camera.
        scale: The number of voxels per m.
        v: The image row.
        found: The stored distances (8, W) around the points.
        points: The points (3, W) at the depths, in voxels.
        converged: The maximum length of the last step, voxels.
        reach: The maximum length of a step, voxels.
        limits: The maximum depths (W,), m.
        depth: The depths (W,), m, modified in place.
        normals: The output (3, W), the normalized gradients.
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
    """Interpolate the colors of an image row between the voxels around each point.

    Args:
        found: The packed colors (8, W) around the points.
        points: The points (3, W), in voxels. They are overwritten.
        color: The output (W, 3), RGB.
    """
    half = np.float32(0.5)
    for n in range(points.shape[1]):
        x, y, z = points[0, n], points[1, n], points[2, n]
        p = found[0, n], found[1, n], found[2, n], found[3, n], found[4, n], found[5, n], found[6, n], found[7, n]
        red, green, blue = blend(p, x - np.floor(x), y - np.floor(y), z - np.floor(z))
        points[0, n], points[1, n], points[2, n] = red + half, green + half, blue + half
    for n in range(points.shape[1]):
        color[n, 0], color[n, 1], color[n, 2] = np.uint8(points[0, n]), np.uint8(points[1, n]), np.uint8(points[2, n])
