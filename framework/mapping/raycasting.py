"""What a camera sees of the map, by sphere tracing through its blocks.

First the blocks in view are projected to image tiles, which bounds the depths that each tile's rays must search. Then
a ray crosses absent regions and blocks in one step each, walks the truncated distance field by steps of the distance
itself, and finds the surface where the field changes from positive to negative, refined on the trilinear field (secant
method).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Camera, Float32, Float64, View
from framework.geometry import inverse
from framework.mapping.evidence import Evidence, best_class, best_instance
from framework.mapping.sensor import Sensor, pinhole, ray_direction, seen_point
from framework.mapping.voxel_grid import BLOCK_SIDE, REGION_BLOCKS, REGION_SIDE, UNSEEN, VoxelGrid, find_block
from framework.mapping.voxel_walk import distance_at, inverses, leave_cell, trilinear, trilinear_color, voxel_number

TILE = 8  # px; one tile's rays share blocks in the cache
REFINEMENTS = 4  # secant steps at most: one meets a plane, two or three a curved surface


@njit(cache=True, nogil=True, forceinline=True)
def _on_trilinear_field(grid, origin, dx, dy, dz, z, key, region):
    """trilinear() at the point of the ray at depth z."""
    scale = np.float32(1.0) / grid.voxel_size
    return trilinear(
        grid,
        (origin[0] + z * dx) * scale,
        (origin[1] + z * dy) * scale,
        (origin[2] + z * dz) * scale,
        key,
        region,
    )


@njit(cache=True, nogil=True, forceinline=True)
def _refined(grid, origin, dx, dy, dz, z, distance, inverse_length, key, region):
    """The zero of the trilinear field near depth z, where the nearest voxel has `distance`; 0 if there is none.

    The secant method, started with a unit slope. A zero at which the field rises along the ray is the back of a
    surface.
    """
    voxel = grid.voxel_size
    reach = np.float32(2.0) * voxel * inverse_length
    first = z
    z += distance * inverse_length
    value, valid, key, region = _on_trilinear_field(grid, origin, dx, dy, dz, z, key, region)
    step = value * inverse_length
    slope = np.float32(-1.0)
    for _ in range(REFINEMENTS):
        if not valid or abs(value) < np.float32(2e-3) * voxel:
            break
        z_next = z + step
        value_next, valid, key, region = _on_trilinear_field(grid, origin, dx, dy, dz, z_next, key, region)
        if not valid or value_next == value:
            break
        slope = (value_next - value) / (z_next - z)
        z = z_next
        value = value_next
        step = -value / slope
    near_enough = abs(value) < np.float32(0.05) * voxel and abs(z - first) < reach
    return z if valid and near_enough and slope < np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True, forceinline=True)
def _first_surface(grid, origin, dx, dy, dz, near, far):
    """The depth at which the ray origin + z * d first meets the surface from the front, 0 if it does not."""
    one = np.float32(1.0)
    half = np.float32(0.5)
    voxel = grid.voxel_size
    scale = one / voxel
    block_size = np.float32(BLOCK_SIDE) * voxel
    region_size = np.float32(REGION_SIDE) * block_size
    d = (dx, dy, dz)
    inverse_d = inverses(d)
    # the voxel nearest to a point is the cell that the point moved by half a voxel lies in
    shifted = (origin[0] + half * voxel, origin[1] + half * voxel, origin[2] + half * voxel)
    inverse_length = one / np.sqrt(dx * dx + dy * dy + dz * dz)
    one_voxel = voxel * inverse_length  # in units of z, as is all that follows
    # past a border by a thousandth of a voxel, and by more than z can be rounded, or the ray would stand still
    hair = max(np.float32(1e-3) * one_voxel, np.float32(2.5e-7) * far)
    key = np.int64(-2)
    region = np.int32(-1)
    z = near
    from_front = False  # was the last voxel in front of a surface?
    while z < far:
        i = int(np.floor((shifted[0] + z * dx) * scale))
        j = int(np.floor((shifted[1] + z * dy) * scale))
        k = int(np.floor((shifted[2] + z * dz) * scale))
        block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
        if block < 0:
            size = region_size if region < 0 else block_size
            z = leave_cell(z, shifted, d, inverse_d, size, one / size) + hair
            from_front = False
            continue
        stored = grid.tsdf[block, voxel_number(i, j, k)]
        if stored == UNSEEN:
            z += one_voxel
            from_front = False
            continue
        distance = np.float32(stored) * grid.tsdf_unit
        if abs(distance) < voxel or (from_front and stored < 0):
            hit = _refined(grid, origin, dx, dy, dz, z, distance, inverse_length, key, region)
            if hit > np.float32(0.0) and hit < far:
                return hit
        from_front = stored > 0
        z += max(distance * inverse_length, one_voxel)
    return np.float32(0.0)


@njit(cache=True, nogil=True)
def _bound_tiles(grid, region_count, camera, near, far, shape, tile_near, tile_far):
    """Fills tile_near and tile_far (Y, X) m with the depths between which a tile's rays can meet a block.

    Regions and blocks are taken for their bounding spheres, so the bounds are never too tight. `camera` holds
    T_camera_world. The cost is a sphere test a region of the map (0.26 m^3 at 1 cm voxels) and the blocks of those in
    view.
    """
    tile_near[:] = far
    tile_far[:] = near
    voxel = grid.voxel_size
    block_size = np.float32(BLOCK_SIDE) * voxel
    region_size = np.float32(REGION_SIDE) * block_size
    block_radius = np.float32(0.8661) * block_size + voxel
    region_radius = np.float32(0.8661) * region_size + voxel
    half = np.float32(0.5)
    for region in range(region_count):
        x = (np.float32(grid.region_coords[region, 0]) + half) * region_size
        y = (np.float32(grid.region_coords[region, 1]) + half) * region_size
        z = (np.float32(grid.region_coords[region, 2]) + half) * region_size
        if not _bounds(camera, x, y, z, region_radius, near, far, shape)[0]:
            continue
        for child in range(REGION_BLOCKS):
            block = grid.region_blocks[region, child]
            if block < 0:
                continue
            x = (np.float32(grid.block_coords[block, 0]) + half) * block_size
            y = (np.float32(grid.block_coords[block, 1]) + half) * block_size
            z = (np.float32(grid.block_coords[block, 2]) + half) * block_size
            visible, depth, u0, u1, v0, v1 = _bounds(camera, x, y, z, block_radius, near, far, shape)
            if not visible:
                continue
            low, high = max(near, depth - block_radius), min(far, depth + block_radius)
            for ty in range(v0 // TILE, v1 // TILE + 1):
                for tx in range(u0 // TILE, u1 // TILE + 1):
                    tile_near[ty, tx] = min(tile_near[ty, tx], low)
                    tile_far[ty, tx] = max(tile_far[ty, tx], high)


@njit(cache=True, nogil=True, forceinline=True)
def _bounds(camera, x, y, z, radius, near, far, shape):
    """(visible, depth, u0, u1, v0, v1): the pixels, inclusive, that a sphere in the world can cover."""
    height, width = shape
    pz = camera.R[2, 0] * x + camera.R[2, 1] * y + camera.R[2, 2] * z + camera.t[2]
    if pz + radius < near or pz - radius > far:
        return False, pz, 0, 0, 0, 0
    if pz < np.float32(2.0) * radius:  # the camera is in or beside the sphere: no useful bound
        return True, pz, 0, width - 1, 0, height - 1
    px = camera.R[0, 0] * x + camera.R[0, 1] * y + camera.R[0, 2] * z + camera.t[0]
    py = camera.R[1, 0] * x + camera.R[1, 1] * y + camera.R[1, 2] * z + camera.t[1]
    # the sphere lies within the box pz +- radius, px +- radius: its corners give the extreme rays
    z0, z1 = pz - radius, pz + radius
    left, right = px - radius, px + radius
    top, bottom = py - radius, py + radius
    u0 = camera.fx * min(left / z0, left / z1) + camera.cx
    u1 = camera.fx * max(right / z0, right / z1) + camera.cx
    v0 = camera.fy * min(top / z0, top / z1) + camera.cy
    v1 = camera.fy * max(bottom / z0, bottom / z1) + camera.cy
    if u1 < 0 or v1 < 0 or u0 > width - 1 or v0 > height - 1:
        return False, pz, 0, 0, 0, 0
    return True, pz, max(0, int(u0)), min(width - 1, int(u1) + 1), max(0, int(v0)), min(height - 1, int(v1) + 1)


@njit(cache=True, nogil=True, parallel=True)
def cast(grid, view, tile_near, tile_far, depth, normals):
    """Fills depth (H, W) m and normals (H, W, 3), world, of the surface that `view` (T_world_camera) sees; 0 = none.

    Normals are central differences of the distance field at the voxel nearest to the hit.
    """
    height, width = depth.shape
    tiles_y, tiles_x = tile_near.shape
    scale = np.float32(1.0) / grid.voxel_size
    half = np.float32(0.5)
    for tile in prange(tiles_x * tiles_y):
        origin = (view.t[0], view.t[1], view.t[2])
        near, far = tile_near[tile // tiles_x, tile % tiles_x], tile_far[tile // tiles_x, tile % tiles_x]
        key = np.int64(-2)
        region = np.int32(-1)
        for v in range(tile // tiles_x * TILE, min(height, (tile // tiles_x + 1) * TILE)):
            for u in range(tile % tiles_x * TILE, min(width, (tile % tiles_x + 1) * TILE)):
                dx, dy, dz = ray_direction(view, u, v)
                z = _first_surface(grid, origin, dx, dy, dz, near, far)
                depth[v, u] = z
                nx = ny = nz = np.float32(0.0)
                if z > np.float32(0.0):
                    i = int(np.floor((origin[0] + z * dx) * scale + half))
                    j = int(np.floor((origin[1] + z * dy) * scale + half))
                    k = int(np.floor((origin[2] + z * dz) * scale + half))
                    here, key, region = distance_at(grid, i, j, k, np.float32(0.0), key, region)
                    x1, key, region = distance_at(grid, i + 1, j, k, here, key, region)
                    x0, key, region = distance_at(grid, i - 1, j, k, here, key, region)
                    y1, key, region = distance_at(grid, i, j + 1, k, here, key, region)
                    y0, key, region = distance_at(grid, i, j - 1, k, here, key, region)
                    z1, key, region = distance_at(grid, i, j, k + 1, here, key, region)
                    z0, key, region = distance_at(grid, i, j, k - 1, here, key, region)
                    nx, ny, nz = x1 - x0, y1 - y0, z1 - z0
                    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
                    if norm > np.float32(0.0):
                        nx, ny, nz = nx / norm, ny / norm, nz / norm
                normals[v, u, 0] = nx
                normals[v, u, 1] = ny
                normals[v, u, 2] = nz


@njit(cache=True, nogil=True, parallel=True)
def paint(grid, view, depth, color):
    """Fills color (H, W, 3) with the map's colour at the surface that `depth` (H, W) m, seen from `view`, describes."""
    height, width = depth.shape
    scale = np.float32(1.0) / grid.voxel_size
    for v in prange(height):
        key = np.int64(-2)
        region = np.int32(-1)
        for u in range(width):
            z = depth[v, u]
            if z > np.float32(0.0):
                x, y, w = seen_point(view, u, v, z)
                key, region = trilinear_color(grid, x * scale, y * scale, w * scale, key, region, color[v, u])


@njit(cache=True, nogil=True, parallel=True)
def label(grid, evidence, view, depth, instance_ids, class_ids):
    """Fills instance_ids and class_ids (H, W) with the labels of the voxels nearest to the surface at `depth`."""
    height, width = depth.shape
    scale = np.float32(1.0) / grid.voxel_size
    half = np.float32(0.5)
    for v in prange(height):
        key = np.int64(-2)
        region = np.int32(-1)
        for u in range(width):
            instance_ids[v, u] = 0
            class_ids[v, u] = -1
            z = depth[v, u]
            if z > np.float32(0.0):
                x, y, w = seen_point(view, u, v, z)
                i = int(np.floor(x * scale + half))
                j = int(np.floor(y * scale + half))
                k = int(np.floor(w * scale + half))
                block, key, region = find_block(grid, i >> 3, j >> 3, k >> 3, key, region)
                if block >= 0 and grid.label_row[block] >= 0:
                    row = grid.label_row[block]
                    n = voxel_number(i, j, k)
                    instance_ids[v, u] = best_instance(evidence, row, n)
                    class_ids[v, u] = best_class(evidence, row, n)


def cast_view(voxels: VoxelGrid, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Float32]:
    """(depth (H, W) m, normals (H, W, 3) world) of the surface that `camera` sees; depth 0 where there is none."""
    tiles = tuple((side + TILE - 1) // TILE for side in camera.shape)
    tile_near, tile_far = np.empty(tiles, np.float32), np.empty(tiles, np.float32)
    _bound_tiles(
        voxels.grid,
        voxels.region_count,
        pinhole(camera, inverse(T_world_camera)),
        sensor.min_depth,
        sensor.max_depth,
        camera.shape,
        tile_near,
        tile_far,
    )
    depth = np.empty(camera.shape, np.float32)
    normals = np.empty((*camera.shape, 3), np.float32)
    cast(voxels.grid, pinhole(camera, T_world_camera), tile_near, tile_far, depth, normals)
    return depth, normals


def render(voxels: VoxelGrid, evidence: Evidence, sensor: Sensor, camera: Camera, T_world_camera: Float64) -> View:
    """What `camera` sees of the map, between the sensor's nearest and farthest depth."""
    depth, normals = cast_view(voxels, sensor, camera, T_world_camera)
    view = pinhole(camera, T_world_camera)
    color = np.zeros((*camera.shape, 3), np.uint8)
    instance_ids = np.empty(camera.shape, np.int32)
    class_ids = np.empty(camera.shape, np.int32)
    paint(voxels.grid, view, depth, color)
    label(voxels.grid, evidence, view, depth, instance_ids, class_ids)
    return View(camera, T_world_camera, depth, normals, color, instance_ids, class_ids)
