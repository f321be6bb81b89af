"""Kernels of raycasting.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.label_evidence_kernels import best_class, best_instance, labeled_voxel
from framework.mapping.voxels.voxel_grid import REGION_SIDE
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, NO_LOOK_UP, UNSEEN, device, find_block
from framework.mapping.voxels.voxel_walk import (
    blend_colors,
    gather_corners,
    inverses,
    leave_cell,
    points_of_row,
    ray_direction,
    seen_point,
    step_to_surface,
    trilinear,
    voxel_number,
)
from framework.sensors.noise_models_kernels import axial_sigma_single

TILE = 8  # side of a tile, px; the rays of a tile share blocks in the cache
REFINEMENTS = 4  # maximum number of Newton steps of a ray; a plane needs one, a curved surface two or three
CONVERGED = 0.2  # maximum length of the last Newton step, voxels; the remaining error is a few hundredths of a voxel
REACH = 3.0  # maximum distance from the start of a refinement to the surface, voxels
DETAIL = 4.0  # maximum spacing of coarse rays, voxels; maps have few details smaller than the truncation band
MARGIN = 8.0  # maximum protrusion of a surface between the coarse rays that hit it, voxels
STEEPEST = 24.0  # maximum depth difference between coarse rays on one surface, voxels; a distant floor reaches it
MAX_SHIFT = 10.0  # maximum distance between a depth reading and the surface of the map, voxels


@device
def _ray(view, scale, u, v):
    """Return the ray of a pixel, voxels per m of depth, and the depth of one voxel along the ray, m."""
    dx, dy, dz = ray_direction(view, u, v)
    dx, dy, dz = dx * scale, dy * scale, dz * scale
    return (dx, dy, dz), np.float32(1.0) / np.sqrt(dx * dx + dy * dy + dz * dz)


@device
def _refined(grid, o, d, step, z, reach, key, region):
    """Return (z, nx, ny, nz, key, region) of the zero crossing near depth z.

    z is 0 if there is no front face within `reach`, m. The gradient (nx, ny, nz) is in stored units per voxel. See
    find_block() for `key` and `region`.
    """
    zero = np.float32(0.0)
    nx = ny = nz = zero
    start = z
    for _ in range(REFINEMENTS):  # Newton's method
        x, y, w = o[0] + z * d[0], o[1] + z * d[1], o[2] + z * d[2]
        i, j, k = np.int32(np.floor(x)), np.int32(np.floor(y)), np.int32(np.floor(w))
        block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
        if block < 0:
            break
        value, nx, ny, nz, seen = trilinear(grid, block, x, y, w)
        slope = nx * d[0] + ny * d[1] + nz * d[2]
        if not seen or slope >= zero:
            break
        change = -value / slope
        z += change
        if not abs(z - start) < reach:
            break
        if abs(change) < np.float32(CONVERGED) * step:
            return z, nx, ny, nz, key, region
    return zero, nx, ny, nz, key, region


@device
def _first_surface(grid, o, d, step, near, far, key, region):
    """Return (z, nx, ny, nz, key, region) of the first front face between two depths.

    z is 0 if there is no front face. See _refined() for the parameters.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    to_voxels = grid.tsdf_unit / grid.voxel_size
    reach = np.float32(REACH) * step
    block_side = np.float32(BLOCK_SIDE)
    region_side = np.float32(BLOCK_SIDE * REGION_SIDE)
    inverse_d = inverses(d)
    # the nearest voxel to a point is the cell of the point shifted by half a voxel
    shifted = (o[0] + half, o[1] + half, o[2] + half)
    # step past the border by more than the rounding error of z, because otherwise the ray would not advance
    margin = max(np.float32(1e-3) * step, np.float32(2.5e-7) * far)
    z = near
    from_front = False  # True if the previous voxel was in front of a surface
    while z < far:
        i = np.int32(np.floor(shifted[0] + z * d[0]))
        j = np.int32(np.floor(shifted[1] + z * d[1]))
        k = np.int32(np.floor(shifted[2] + z * d[2]))
        block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
        if block < 0:
            side = region_side if region < 0 else block_side
            z = leave_cell(z, shifted, d, inverse_d, side, one / side) + margin
            from_front = False
            continue
        stored = grid.tsdf[np.uint32(block), np.uint32(voxel_number(i, j, k))]
        if stored == UNSEEN:
            z += step + step  # this skips no surface, because more than one observed voxel is in front of each surface
            from_front = False
            continue
        distance = np.float32(stored) * to_voxels
        if abs(distance) < one or (from_front and stored < 0):
            hit, nx, ny, nz, key, region = _refined(grid, o, d, step, z + distance * step, reach, key, region)
            if zero < hit < far:
                return hit, nx, ny, nz, key, region
        from_front = stored > 0
        z += max(distance, one) * step
    return zero, zero, zero, zero, key, region


@njit(cache=True, nogil=True)
def bound_tiles(depths, pixels, tile_near, tile_far):
    """Extend the depth bounds of the tiles to include the given blocks.

    Args:
        depths: The minimum and maximum depth (N, 2) of each block, m.
        pixels: The pixel window (N, 4) of each block: u0, u1, v0, v1, inclusive.
        tile_near: The minimum depth (Y, X) of each tile, m, modified in place.
        tile_far: The maximum depth (Y, X) of each tile, m, modified in place.
    """
    for n in range(depths.shape[0]):
        u0, u1, v0, v1 = pixels[n]
        for ty in range(v0 // TILE, v1 // TILE + 1):
            for tx in range(u0 // TILE, u1 // TILE + 1):
                tile_near[ty, tx] = min(tile_near[ty, tx], depths[n, 0])
                tile_far[ty, tx] = max(tile_far[ty, tx], depths[n, 1])


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def cast_coarse(grid, view, tile_near, tile_far, stride, shape, depth):
    """Cast a ray at every stride-th pixel, and in the last row and column of the image.

    Args:
        grid: The voxel grid.
        view: The camera with the pose T_world_camera.
        tile_near: The minimum depth (Y, X) of each tile, m.
        tile_far: The maximum depth (Y, X) of each tile, m.
        stride: The spacing of the rays, px.
        shape: The height and width of the image.
        depth: The output (ceil((H - 1) / stride) + 1, ceil((W - 1) / stride) + 1), m, 0 = no surface.
    """
    scale = np.float32(1.0) / grid.voxel_size
    for y in prange(depth.shape[0]):
        o = (view.t[0] * scale, view.t[1] * scale, view.t[2] * scale)
        key, region = NO_LOOK_UP
        v = min(y * stride, shape[0] - 1)
        for x in range(depth.shape[1]):
            u = min(x * stride, shape[1] - 1)
            d, step = _ray(view, scale, u, v)
            near, far = tile_near[v // TILE, u // TILE], tile_far[v // TILE, u // TILE]
            z, _, _, _, key, region = _first_surface(grid, o, d, step, near, far, key, region)
            depth[y, x] = z


@device
def _search_cells(above, below, row_near, row_far, stride, voxel, resolved, near, far, corners):
    """Find the depth range to search in each cell between two rows of coarse rays.

    Args:
        above: The depths (X + 1,) of the upper rays, m, -1 = not searched.
        below: The depths (X + 1,) of the lower rays, m, -1 = not searched.
        row_near: The minimum depth of each tile in this image row, m.
        row_far: The maximum depth of each tile in this image row, m.
        stride: The spacing of the rays, px.
        voxel: The voxel size, m.
        resolved: The maximum depth at which the rays resolve all details, m.
        near: The output (X,), the minimum depth of each cell, m.
        far: The output (X,), the maximum depth of each cell, m, 0 = no surface.
        corners: The output (4, X), the inverse depths of the surface, 1 / m, in row order. They are 0 unless the cell
            has exactly one surface.
    """
    zero, one, none = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
    margin, rise = np.float32(MARGIN) * voxel, np.float32(STEEPEST) * voxel
    for x in range(near.shape[0]):
        near[x], far[x] = row_near[x * stride // TILE], row_far[x * stride // TILE]
        corners[0, x], corners[1, x], corners[2, x], corners[3, x] = above[x], above[x + 1], below[x], below[x + 1]
        nearest, farthest, total = none, zero, zero
        hits = 0
        known = True
        for c in range(4):
            z = corners[c, x]
            if z > zero:
                nearest, farthest = min(nearest, z), max(farthest, z)
                corners[c, x] = one / z
                total += one / z
                hits += 1
            elif z < zero:
                known = False
                corners[c, x] = zero
        if hits == 0:
            far[x] = zero if known and far[x] < resolved else far[x]
        elif (farthest if hits == 4 else far[x]) < resolved:
            near[x], far[x] = max(near[x], nearest - margin), min(far[x], farthest + margin)
        if hits == 0 or farthest > resolved or farthest - nearest > rise:
            corners[0, x] = corners[1, x] = corners[2, x] = corners[3, x] = zero
        elif hits < 4:
            # inverse depth is linear in the image of a plane: three corners determine the fourth
            for c in range(4):
                if corners[c, x] == zero:
                    corners[c, x] = (
                        total - np.float32(2.0) * corners[3 - c, x] if hits == 3 else total / np.float32(hits)
                    )


@device
def _start_row(corners, b, stride, limits, depth):
    """Interpolate the depths (W,) of an image row between the corners of its cells, 0 = unknown.

    The vertical position `b` is 0 at the upper corners and 1 at the lower corners.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    width = depth.shape[0]
    for x in range(corners.shape[1]):
        u0, u1 = x * stride, min((x + 1) * stride, width - 1)
        left = corners[0, x] + b * (corners[2, x] - corners[0, x])
        right = corners[1, x] + b * (corners[3, x] - corners[1, x])
        slope = (right - left) / np.float32(max(u1 - u0, 1))
        for u in range(u0, u1 + 1 if u1 == width - 1 else u1):
            z = one / (left + slope * np.float32(u - u0))
            depth[u] = z if zero < z < limits[u] else zero


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def cast_fine(grid, view, tile_near, tile_far, limits, stride, coarse, depth, normals):
    """Compute the depth and the normal of the visible surface at every pixel.

    Args:
        grid: The voxel grid.
        view: The camera with the pose T_world_camera.
        tile_near: The minimum depth (Y, X) of each tile, m.
        tile_far: The maximum depth (Y, X) of each tile, m.
        limits: The maximum depth (H, W) of each pixel, m.
        stride: The spacing of the coarse rays, px.
        coarse: The depths of the coarse rays, from cast_coarse() or cast_near().
        depth: The output (H, W), m, 0 = no surface.
        normals: The output (H, W, 3) in the world frame, the normalized gradients of the signed distance.
    """
    height, width = depth.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    voxel = grid.voxel_size
    scale = one / voxel
    # maximum depth at which coarse rays resolve all details
    resolved = np.float32(DETAIL) * voxel * min(view.fx, view.fy) / np.float32(stride)
    cells = coarse.shape[1] - 1
    for y in prange(coarse.shape[0] - 1):
        o = (view.t[0] * scale, view.t[1] * scale, view.t[2] * scale)
        key, region = NO_LOOK_UP
        near, far = np.empty(cells, np.float32), np.empty(cells, np.float32)
        corners = np.empty((4, cells), np.float32)
        points, gradients = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
        found = np.empty((8, width), np.int16)
        v0, v1 = y * stride, min((y + 1) * stride, height - 1)
        row_near, row_far = tile_near[v0 // TILE], tile_far[v0 // TILE]
        _search_cells(coarse[y], coarse[y + 1], row_near, row_far, stride, voxel, resolved, near, far, corners)
        for v in range(v0, v1 + 1 if v1 == height - 1 else v1):
            row = depth[v]
            _start_row(corners, np.float32(v - v0) / np.float32(max(v1 - v0, 1)), stride, limits[v], row)
            points_of_row(view, scale, v, row, points)
            gather_corners(grid, grid.tsdf, row, points, np.int16(UNSEEN), found)
            converged, reach = np.float32(CONVERGED), np.float32(REACH)
            step_to_surface(view, scale, v, found, points, converged, reach, limits[v], row, gradients)
            for u in range(width):
                z = row[u]
                if z <= zero:
                    nx = ny = nz = zero
                    x = min(u // stride, cells - 1)
                    if far[x] > zero and limits[v, u] > zero:
                        d, step = _ray(view, scale, u, v)
                        if z < zero:
                            z, nx, ny, nz, key, region = _refined(grid, o, d, step, -z, reach * step, key, region)
                            z = z if zero < z < limits[v, u] else zero
                        if z == zero:
                            last = min(far[x], limits[v, u])
                            z, nx, ny, nz, key, region = _first_surface(grid, o, d, step, near[x], last, key, region)
                    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
                    norm = one / norm if z > zero else zero  # at a surface the norm is not 0
                    row[u] = z
                    gradients[0, u], gradients[1, u], gradients[2, u] = nx * norm, ny * norm, nz * norm
                normals[v, u, 0] = gradients[0, u]
                normals[v, u, 1] = gradients[1, u]
                normals[v, u, 2] = gradients[2, u]


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def cast_near(grid, view, tile_near, tile_far, limits, stride, readings, noise, depth):
    """Cast the rays of cast_coarse(), starting at the depth readings of a sensor.

    Rays with a limit of 0 are not searched.

    Args:
        grid: The voxel grid.
        view: The camera with the pose T_world_camera.
        tile_near: The minimum depth (Y, X) of each tile, m.
        tile_far: The maximum depth (Y, X) of each tile, m.
        limits: The maximum depth (H, W) of each pixel, m.
        stride: The spacing of the rays, px.
        readings: The depth readings (H, W), m.
        noise: The depth noise parameters of the sensor.
        depth: The output, at the rays of cast_coarse(), m, 0 = no surface, -1 = not searched.
    """
    height, width = readings.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    voxel = grid.voxel_size
    scale = one / voxel
    for y in prange(depth.shape[0]):
        o = (view.t[0] * scale, view.t[1] * scale, view.t[2] * scale)
        key, region = NO_LOOK_UP
        shift = zero
        last = last_but_one = zero  # inverse depths of the previous rays, 0 = no surface
        v = min(y * stride, height - 1)
        for x in range(depth.shape[1]):
            u = min(x * stride, width - 1)
            z = zero
            reading = readings[v, u]
            if limits[v, u] > zero:
                d, step = _ray(view, scale, u, v)
                # Readings are noisy and displaced by pose errors. Start at the extrapolation of the two previous rays
                # if it agrees with the reading.
                start = reading + shift
                reach = np.float32(REACH) * voxel + np.float32(3.0) * axial_sigma_single(reading, noise)
                if last_but_one > zero and last > zero:
                    extrapolated = one / max(last + last - last_but_one, np.float32(1e-3))
                    if abs(extrapolated - start) < reach:
                        start = extrapolated
                z, _, _, _, key, region = _refined(grid, o, d, step, start, reach, key, region)
                if z == zero:
                    near, far = tile_near[v // TILE, u // TILE], min(tile_far[v // TILE, u // TILE], limits[v, u])
                    z, _, _, _, key, region = _first_surface(grid, o, d, step, near, far, key, region)
                displacement = z - reading
                shift = displacement if z > zero and abs(displacement) < np.float32(MAX_SHIFT) * voxel else zero
            last_but_one = last
            last = one / z if z > zero else zero
            depth[y, x] = z if z > zero or limits[v, u] > zero else -one


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def paint(grid, view, depth, color):
    """Fill the colors (H, W, 3), RGB, of the surface at the given depths (H, W), m.

    The pose in `view` is T_world_camera.
    """
    height, width = depth.shape
    scale = np.float32(1.0) / grid.voxel_size
    for v in prange(height):
        points = np.empty((3, width), np.float32)
        found = np.empty((8, width), np.uint32)
        points_of_row(view, scale, v, depth[v], points)
        gather_corners(grid, grid.color, depth[v], points, np.uint32(0), found)
        blend_colors(found, points, color[v])


@device
def voxel_seen(grid, view, u, v, z, key, region):
    """Return (block, index, key, region) of the voxel nearest to pixel (u, v) at depth z, m.

    See find_block() for `key` and `region`.
    """
    scale = np.float32(1.0) / grid.voxel_size
    half = np.float32(0.5)
    x, y, w = seen_point(view, u, v, z)
    i = int(np.floor(x * scale + half))
    j = int(np.floor(y * scale + half))
    k = int(np.floor(w * scale + half))
    block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
    return block, voxel_number(i, j, k), key, region


@njit(cache=True, nogil=True, parallel=True)
def label(grid, evidence, view, depth, instance_ids, class_ids):
    """Fill the instance and class of each pixel from the voxel nearest to the surface.

    Args:
        grid: The voxel grid.
        evidence: The label evidence.
        view: The camera with the pose T_world_camera.
        depth: The depth (H, W) of the surface, m.
        instance_ids: The output (H, W), 0 = none.
        class_ids: The output (H, W), -1 = none.
    """
    height, width = depth.shape
    for v in prange(height):
        key, region = NO_LOOK_UP
        for u in range(width):
            instance_ids[v, u] = 0
            class_ids[v, u] = -1
            z = depth[v, u]
            if z > np.float32(0.0):
                block, n, key, region = voxel_seen(grid, view, u, v, z, key, region)
                voxel = labeled_voxel(grid, evidence, block, n)
                if voxel >= 0:
                    instance_ids[v, u] = best_instance(evidence, voxel)
                    class_ids[v, u] = best_class(evidence, voxel)
