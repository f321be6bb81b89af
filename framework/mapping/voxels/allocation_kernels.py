"""Kernels of allocation.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.voxel_grid import REGION_BLOCKS, REGION_SIDE
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, NO_KEY, device, pack_key, unpack_key
from framework.mapping.voxels.voxel_walk import ray_direction

CHUNKS = 32  # fixed number of chunks of image rows, so that block order does not depend on the number of threads
WORD = 64  # number of bits of a word
RECENT = 1024  # number of recent block keys that a chunk caches, so that most blocks are listed once
PROBES = 4  # number of probed pixels along each side of a block in the image, to detect readings behind it


@device
def _remembered(recent, key):
    """Return True if the key is in the cache, otherwise add it."""
    slot = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(54)
    if recent[slot] == key:
        return True
    recent[slot] = key
    return False


@device
def _band_keys(readings, v, view, sensor, inverse_size, stride, samples, keys):
    """Write the keys of the blocks along the truncation bands of an image row to keys[1:].

    `readings` are every stride-th depth reading of row v, m. Readings out of range get NO_KEY.
    """
    # local variables, so that the compiler vectorizes the loop
    width = readings.shape[0]
    first_x, first_y, first_z = ray_direction(view, 0, v)
    second_x, second_y, second_z = ray_direction(view, stride, v)
    step_x, step_y, step_z = second_x - first_x, second_y - first_y, second_z - first_z
    tx, ty, tz = view.t[0], view.t[1], view.t[2]
    nearest, farthest = sensor.min_depth, sensor.max_depth
    truncation, slope = sensor.truncation, sensor.truncation_slope
    for s in range(samples):
        offset = np.float32(2.0) * np.float32(s) / np.float32(samples - 1) - np.float32(1.0)
        for n in range(width):
            column = np.float32(np.int32(n))
            d = readings[n]
            z = d + offset * (truncation + slope * d)
            bx = np.int32(np.floor((tx + z * (first_x + column * step_x)) * inverse_size))
            by = np.int32(np.floor((ty + z * (first_y + column * step_y)) * inverse_size))
            bz = np.int32(np.floor((tz + z * (first_z + column * step_z)) * inverse_size))
            valid = (d >= nearest) & (d <= farthest)
            keys[1 + s * width + n] = pack_key(bx, by, bz) if valid else np.int64(NO_KEY)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def surface_blocks(depth, view, sensor, block_size, stride, samples, found, counts):
    """Write the keys of the blocks along the truncation bands of a depth image to `found` (CHUNKS, M).

    Args:
        depth: The depth image (H, W), m. Every stride-th pixel of every stride-th row is used.
        view: The camera with the pose T_world_camera.
        sensor: The integration parameters.
        block_size: The side of a block, m.
        stride: The distance between the used pixels, px.
        samples: The number of samples along a truncation band.
        found: The output.
        counts: The number of keys (CHUNKS,) of each chunk. If a count exceeds M, `found` is too small.
    """
    height, width = depth.shape
    rows, columns = (height + stride - 1) // stride, (width + stride - 1) // stride
    inverse_size = np.float32(1.0) / block_size
    for chunk in prange(CHUNKS):
        recent = np.full(RECENT, NO_KEY, np.int64)
        readings = np.empty(columns, np.float32)
        words = (samples * columns + WORD - 1) // WORD
        keys = np.full(1 + words * WORD, NO_KEY, np.int64)
        n = 0
        for row in range(chunk * rows // CHUNKS, (chunk + 1) * rows // CHUNKS):
            for column in range(columns):
                readings[column] = depth[row * stride, column * stride]
            _band_keys(readings, row * stride, view, sensor, inverse_size, stride, samples, keys)
            for start in range(0, words * WORD, WORD):
                word = np.uint64(0)  # bits of the keys that differ from the previous key; vectorized
                for i in range(WORD):
                    word |= np.uint64(keys[start + i + 1] != keys[start + i]) << np.uint64(i)
                while word != np.uint64(0):
                    key = keys[1 + start + lowest_bit(word)]
                    word &= word - ONE
                    if key != NO_KEY and not _remembered(recent, key):
                        if n < found.shape[1]:
                            found[chunk, n] = key
                        n += 1
        counts[chunk] = n


@njit(cache=True, nogil=True)
def unpack(keys, coords):
    """Write the block coordinates of packed keys (N,) to `coords` (N, 3)."""
    for i in range(keys.shape[0]):
        coords[i, 0], coords[i, 1], coords[i, 2] = unpack_key(keys[i])


@device
def _extent(camera, size, margin):
    """Return half the side lengths of the camera-aligned box around a world-aligned cube, plus a margin, m."""
    half = np.float32(0.5) * size
    return (
        half * (abs(camera.R[0, 0]) + abs(camera.R[0, 1]) + abs(camera.R[0, 2])) + margin,
        half * (abs(camera.R[1, 0]) + abs(camera.R[1, 1]) + abs(camera.R[1, 2])) + margin,
        half * (abs(camera.R[2, 0]) + abs(camera.R[2, 1]) + abs(camera.R[2, 2])) + margin,
    )


@device
def _bounds(camera, x, y, z, extent, near, far, shape):
    """Return (visible, z0, z1, u0, u1, v0, v1), the depth range, m, and the pixel window of a camera-aligned box.

    Args:
        camera: The camera with the pose T_camera_world.
        x: The first world coordinate of the center, m.
        y: The second world coordinate of the center, m.
        z: The third world coordinate of the center, m.
        extent: Half the side lengths of the box, m.
        near: The minimum depth, m.
        far: The maximum depth, m.
        shape: The height and width of the image.
    """
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
    """Return the blocks (N,) in view that contain a surface, their depths (N, 2), m, and pixel windows (N, 4).

    The depths are the minimum and the maximum. The windows are u0, u1, v0, v1, inclusive. The pose in `camera` is
    T_camera_world.
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


@njit(cache=True, nogil=True, error_model="numpy")
def _sees_through(depth, sensor, z0, pixels):
    """Return True if any probed depth reading in a pixel window is behind the depth z0, m."""
    u0, u1, v0, v1 = pixels
    for row in range(PROBES):
        v = v0 + (v1 - v0) * row // (PROBES - 1)
        for column in range(PROBES):
            d = depth[v, u0 + (u1 - u0) * column // (PROBES - 1)]
            if sensor.min_depth <= d <= sensor.max_depth and d > z0:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def choose_blocks(grid, found, region_count, depth, camera, sensor, stamp, frame, active):
    """Write the blocks that a frame updates to `active`, each once, and return their number.

    Args:
        grid: The voxel grid.
        found: The blocks (N,) along the truncation bands, with repetitions.
        region_count: The number of regions.
        depth: The depth image (H, W), m.
        camera: The camera with the pose T_camera_world.
        sensor: The integration parameters.
        stamp: The number (B,) of the last frame in which each block was active, modified in place.
        frame: The number of the current frame.
        active: The output.
    """
    n = 0
    for i in range(found.shape[0]):
        block = found[i]
        if stamp[block] != frame:
            stamp[block] = frame
            active[n] = block
            n += 1
    # only blocks with a surface need updates of free space
    blocks, depths, pixels = solid_blocks_in_view(
        grid, region_count, stamp.shape[0], camera, sensor.min_depth, sensor.max_depth, depth.shape
    )
    for i in range(blocks.shape[0]):
        block = blocks[i]
        if stamp[block] != frame and _sees_through(depth, sensor, depths[i, 0], pixels[i]):
            stamp[block] = frame
            active[n] = block
            n += 1
    return n
