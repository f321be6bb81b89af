"""Kernels of allocation.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.mapping.voxels.bit_slices import ONE, lowest_bit
from framework.mapping.voxels.frustum_kernels import solid_blocks_in_view
from framework.mapping.voxels.voxel_grid_kernels import NO_KEY, device, pack_key, unpack_key
from framework.mapping.voxels.voxel_walk import ray_direction

CHUNKS = 32  # of image rows; fixed, so that the order of blocks does not depend on the number of threads
WORD = 64  # bits
RECENT = 1024  # block keys that a chunk remembers, to pass on each block about once
PROBES = 4  # pixels along each side of a block in the image, to tell whether the frame sees through it


@device
def _remembered(recent, key):
    """True when the key was passed to `recent` (RECENT,) lately; remembers it otherwise."""
    slot = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(54)
    if recent[slot] == key:
        return True
    recent[slot] = key
    return False


@device
def _band_keys(readings, v, view, sensor, inverse_size, stride, samples, keys):
    """The keys of the blocks at `samples` places along the truncation band of a row's readings, into keys[1:], place by
    place.

    All that the loop reads stands in local variables, so that the compiler vectorises it.
    """
    width = readings.shape[0]
    first_x, first_y, first_z = ray_direction(view, 0, v)
    second_x, second_y, second_z = ray_direction(view, stride, v)
    step_x, step_y, step_z = second_x - first_x, second_y - first_y, second_z - first_z
    tx, ty, tz = view.t[0], view.t[1], view.t[2]
    nearest, farthest = sensor.min_depth, sensor.max_depth
    truncation, slope = sensor.truncation, sensor.truncation_slope
    for s in range(samples):
        place = np.float32(2.0) * np.float32(s) / np.float32(samples - 1) - np.float32(1.0)
        for n in range(width):
            column = np.float32(np.int32(n))
            d = readings[n]
            z = d + place * (truncation + slope * d)
            bx = np.int32(np.floor((tx + z * (first_x + column * step_x)) * inverse_size))
            by = np.int32(np.floor((ty + z * (first_y + column * step_y)) * inverse_size))
            bz = np.int32(np.floor((tz + z * (first_z + column * step_z)) * inverse_size))
            valid = (d >= nearest) & (d <= farthest)
            keys[1 + s * width + n] = pack_key(bx, by, bz) if valid else np.int64(NO_KEY)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def surface_blocks(depth, view, sensor, block_size, stride, samples, found, counts):
    """Keys of blocks along the band of every stride-th reading, chunk by chunk, into `found` (CHUNKS, M).

    Counts (CHUNKS,) above M mean that there was no room for all.
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
            for first in range(0, words * WORD, WORD):
                word = np.uint64(0)  # a bit where the key is another than the one before, which the compiler vectorises
                for i in range(WORD):
                    word |= np.uint64(keys[first + i + 1] != keys[first + i]) << np.uint64(i)
                while word != np.uint64(0):
                    key = keys[1 + first + lowest_bit(word)]
                    word &= word - ONE
                    if key != NO_KEY and not _remembered(recent, key):
                        if n < found.shape[1]:
                            found[chunk, n] = key
                        n += 1
        counts[chunk] = n


@njit(cache=True, nogil=True)
def unpack(keys, coords):
    for i in range(keys.shape[0]):
        coords[i, 0], coords[i, 1], coords[i, 2] = unpack_key(keys[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _sees_through(depth, sensor, z0, pixels):
    """Whether one of some readings within the block's part of the image lies behind the block's front, at depth z0."""
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
    """The blocks `found` (N,) and those that the frame sees through, each once, into `active`; returns how many.

    `camera` holds T_camera_world.
    """
    n = 0
    for i in range(found.shape[0]):
        block = found[i]
        if stamp[block] != frame:
            stamp[block] = frame
            active[n] = block
            n += 1
    # where nothing is behind a surface, there is no surface to be carved
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
