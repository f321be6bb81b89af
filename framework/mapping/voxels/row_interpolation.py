"""Reading the voxel grid at the points that an image row sees, in passes that the compiler vectorises.

A look-up waits for the memory and branches, and arithmetic does neither. So a pass of its own gathers the eight corners
around each point, where the processor has many loads under way at once, and the arithmetic follows eight pixels at a
time. Arrays of a row have the pixel as their last axis.
"""

from __future__ import annotations

import numpy as np

from framework.mapping.voxels.voxel_grid_kernels import device, find_block
from framework.mapping.voxels.voxel_walk import all_seen, blend, corners, interpolate, ray_direction


@device
def directions(view, scale, v):
    """(first, change): the ray of pixel (0, v) in voxels for each m of depth, and what it changes from pixel to pixel.

    `scale` is voxels a m.
    """
    x, y, z = ray_direction(view, 0, v)
    change = scale / view.fx  # not the difference of two rays, whose rounding would grow along the row
    return (x * scale, y * scale, z * scale), (view.R[0, 0] * change, view.R[1, 0] * change, view.R[2, 0] * change)


@device
def points_of_row(view, scale, v, depth, points):
    """Fills points (3, W), voxels, with what the pixels of row v see at `depth` (W,) m."""
    first, change = directions(view, scale, v)
    tx, ty, tz = view.t[0] * scale, view.t[1] * scale, view.t[2] * scale
    for n in range(depth.shape[0]):
        u = np.float32(np.int32(n))
        z = depth[n]
        points[0, n] = tx + z * (first[0] + u * change[0])
        points[1, n] = ty + z * (first[1] + u * change[1])
        points[2, n] = tz + z * (first[2] + u * change[2])


@device
def gather_corners(grid, values, depth, points, missing, found):
    """Fills found (8, W) with what `values` (B, 512) holds for the eight voxels around each point that lies at a depth.

    It is `missing` where there is no block, and for pixels without depth.
    """
    key = np.int64(-2)
    region = np.int32(-1)
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
    """One Newton step of each pixel's depth (W,) m, along its ray, towards the zero of the trilinear field.

    `found` (8, W) holds the distances around `points` (3, W). depth becomes 0 where the field is unknown, does not fall
    along the ray, or is farther away than `reach` voxels; it is negated where the step was longer than `converged`
    voxels. normals (3, W) gets the direction of the field's gradient.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    first, change = directions(view, scale, v)
    for n in range(depth.shape[0]):
        u = np.float32(np.int32(n))
        dx, dy, dz = first[0] + u * change[0], first[1] + u * change[1], first[2] + u * change[2]
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
    """Fills color (W, 3) with what lies between the packed colours `found` (8, W) around `points` (3, W)."""
    half = np.float32(0.5)
    for n in range(points.shape[1]):
        x, y, z = points[0, n], points[1, n], points[2, n]
        p = found[0, n], found[1, n], found[2, n], found[3, n], found[4, n], found[5, n], found[6, n], found[7, n]
        red, green, blue = blend(p, x - np.floor(x), y - np.floor(y), z - np.floor(z))
        points[0, n], points[1, n], points[2, n] = red + half, green + half, blue + half
    for n in range(points.shape[1]):
        color[n, 0], color[n, 1], color[n, 2] = np.uint8(points[0, n]), np.uint8(points[1, n]), np.uint8(points[2, n])
