"""Kernels of voxel_grid.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit

BLOCK_SIDE = 8  # side of a block, voxels
BLOCK_VOXELS = BLOCK_SIDE**3
UNSEEN = -32768  # stored distance of an unobserved voxel; makes it unnecessary to read the weight
NO_KEY = -1  # key of a free slot
NO_LOOK_UP = (np.int64(-2), np.int32(-1))  # key and region before the first find_block()

# Decorator for functions in inner loops of kernels. Arrays have no reference counts (_nrt), because threads would wait
# for each other to update them.
device = njit(cache=True, nogil=True, forceinline=True, error_model="numpy", _nrt=False)


@device
def one_more(count, condition):
    """Return count + 1 if the condition is True, otherwise count."""
    # int32, because Numba would add in 64 bits, and half as many numbers would fit into a vector
    return np.int32(count + (np.int32(1) if condition else np.int32(0)))


_KEY_BITS = 21  # bits of each coordinate in a 63-bit key: +-2^20 blocks, 84 km at 1 cm voxels
FARTHEST_BLOCK = 1 << (_KEY_BITS - 1)  # maximum distance of a block from the origin along an axis, in blocks
_KEY_OFFSET = FARTHEST_BLOCK
_KEY_MASK = (1 << _KEY_BITS) - 1


@device
def pack_key(x, y, z):
    """Return the key of the coordinates of a region or a block.

    Coordinates are in [-2^20, 2^20). Keys are nonnegative.
    """
    return (
        ((np.int64(x) + _KEY_OFFSET) & _KEY_MASK) << (2 * _KEY_BITS)
        | ((np.int64(y) + _KEY_OFFSET) & _KEY_MASK) << _KEY_BITS
        | ((np.int64(z) + _KEY_OFFSET) & _KEY_MASK)
    )


@device
def unpack_key(key):
    """Return the coordinates of a key."""
    return (
        np.int32((key >> (2 * _KEY_BITS)) - _KEY_OFFSET),
        np.int32(((key >> _KEY_BITS) & _KEY_MASK) - _KEY_OFFSET),
        np.int32((key & _KEY_MASK) - _KEY_OFFSET),
    )


@device
def _slot(key, size):
    """Return the first slot to probe for a key in a hash table (Fibonacci hashing)."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(32)) & (size - 1)


@device
def find_region(grid, key):
    """Return the index of the region with the given key, -1 = none."""
    size = grid.table_keys.shape[0]
    slot = _slot(key, size)
    while True:  # linear probing
        found = grid.table_keys[slot]
        if found == key:
            return grid.table_regions[slot]
        if found == NO_KEY:
            return np.int32(-1)
        slot = (slot + 1) & (size - 1)


@device
def child_number(bx, by, bz):
    """Return the index of the block at block coordinates (bx, by, bz) in the table of its region."""
    return ((bz & 7) * 8 + (by & 7)) * 8 + (bx & 7)


@device
def find_block(grid, bx, by, bz, last_key, last_region):
    """Return (block, key, region) at block coordinates (bx, by, bz).

    The block is -1 if it is not allocated, and the region is -1 if it does not exist. Pass the key and the region of
    the previous call. Look-ups in the same region are then fast.
    """
    key = pack_key(bx >> 3, by >> 3, bz >> 3)
    if key != last_key:
        last_region = find_region(grid, key)
    if last_region < 0:
        return np.int32(-1), key, last_region
    return grid.region_blocks[last_region, child_number(bx, by, bz)], key, last_region


@njit(cache=True, nogil=True)
def find_blocks(grid, coords, blocks):
    """Write the block indices (N,) at block coordinates (N, 3) to `blocks`, -1 = not allocated."""
    key, region = NO_LOOK_UP
    for i in range(coords.shape[0]):
        blocks[i], key, region = find_block(grid, coords[i, 0], coords[i, 1], coords[i, 2], key, region)


@njit(cache=True, nogil=True)
def insert_blocks(grid, coords, start, region_count, block_count, blocks):
    """Allocate the blocks at the given coordinates, from index `start` on, and write their indices to `blocks` (N,).

    Returns (next, region_count, block_count). If `next` is less than the number of coordinates, the arrays are full.
    The caller then grows the arrays and calls the function again.
    """
    size = grid.table_keys.shape[0]
    region, last_key = np.int32(-1), np.int64(NO_KEY)
    for i in range(start, coords.shape[0]):
        bx, by, bz = coords[i, 0], coords[i, 1], coords[i, 2]
        key = pack_key(bx >> 3, by >> 3, bz >> 3)
        if key != last_key:  # neighbors are usually in the same region
            region = find_region(grid, key)
            last_key = key
        if region < 0:
            if region_count == grid.region_blocks.shape[0] or 2 * (region_count + 1) > size:
                return i, region_count, block_count
            region = np.int32(region_count)
            region_count += 1
            slot = _slot(key, size)
            while grid.table_keys[slot] != NO_KEY:
                slot = (slot + 1) & (size - 1)
            grid.table_keys[slot] = key
            grid.table_regions[slot] = region
            grid.region_coords[region, 0] = bx >> 3
            grid.region_coords[region, 1] = by >> 3
            grid.region_coords[region, 2] = bz >> 3
            grid.region_blocks[region] = -1
        child = child_number(bx, by, bz)
        if grid.region_blocks[region, child] < 0:
            if block_count == grid.block_coords.shape[0]:
                return i, region_count, block_count
            grid.region_blocks[region, child] = block_count
            grid.block_coords[block_count, 0] = bx
            grid.block_coords[block_count, 1] = by
            grid.block_coords[block_count, 2] = bz
            grid.tsdf[block_count] = UNSEEN
            grid.weight[block_count] = 0
            grid.color[block_count] = 0
            grid.solid[block_count] = 0
            grid.label_row[block_count] = -1
            _link_neighbors(grid, block_count)
            block_count += 1
        blocks[i] = grid.region_blocks[region, child]
    return coords.shape[0], region_count, block_count


@njit(cache=True, nogil=True)
def _link_neighbors(grid, block):
    bx, by, bz = grid.block_coords[block, 0], grid.block_coords[block, 1], grid.block_coords[block, 2]
    key, region = NO_LOOK_UP
    for c in range(8):
        dx, dy, dz = c & 1, (c >> 1) & 1, c >> 2
        after, key, region = find_block(grid, bx + dx, by + dy, bz + dz, key, region)
        grid.neighbors[block, c] = after
        before, key, region = find_block(grid, bx - dx, by - dy, bz - dz, key, region)
        if before >= 0:
            grid.neighbors[before, c] = block


# NumPy scalars, because Numba would compute in 64 bits, and half as many numbers would fit into a vector
_CHANNEL = np.int32(1023)
_GREEN = np.int32(10)
_BLUE = np.int32(20)
COLORED = np.uint32(1 << 30)  # marker bit of a color
OUTDATED = np.uint32(1 << 31)  # marker bit of a color that the next observation replaces


@device
def pack_color(red, green, blue):
    """Return a packed color from channels in [0, 1020], i.e. quarters of an 8-bit level."""
    # ten bits per channel, because averages of 8-bit levels would not converge
    return np.uint32(np.int32(red) | np.int32(green) << _GREEN | np.int32(blue) << _BLUE) | COLORED


@njit(cache=True, nogil=True, parallel=True)
def mark_outdated(color, blocks):
    """Mark the packed colors (B, 512) of the first blocks as outdated."""
    for block in prange(blocks):
        for n in range(BLOCK_VOXELS):
            packed = color[block, n]
            color[block, n] = packed | OUTDATED if packed & COLORED else packed


@device
def unpack_color(packed):
    """Return the channels (red, green, blue) of a packed color, in quarters of an 8-bit level."""
    bits = np.int32(packed)
    return (
        np.float32(np.int32(bits & _CHANNEL)),
        np.float32(np.int32((bits >> _GREEN) & _CHANNEL)),
        np.float32(np.int32((bits >> _BLUE) & _CHANNEL)),
    )


@device
def is_solid(tsdf):
    """Return True if any observed voxel of a block is behind a surface."""
    lowest = np.int16(0)
    for n in range(BLOCK_VOXELS):
        stored = tsdf[n]
        lowest = min(lowest, stored if stored != UNSEEN else np.int16(0))
    return lowest < 0


@njit(cache=True, nogil=True)
def find_solid_blocks(grid, block_count):
    """Find the blocks with a voxel behind a surface, among the first `block_count` blocks."""
    for block in range(block_count):
        grid.solid[block] = is_solid(grid.tsdf[block])


@njit(cache=True, nogil=True)
def rehash(old_keys, old_regions, keys, regions):
    """Insert all entries of a hash table into a larger one."""
    size = keys.shape[0]
    for i in range(old_keys.shape[0]):
        if old_keys[i] != NO_KEY:
            slot = _slot(old_keys[i], size)
            while keys[slot] != NO_KEY:
                slot = (slot + 1) & (size - 1)
            keys[slot] = old_keys[i]
            regions[slot] = old_regions[i]
