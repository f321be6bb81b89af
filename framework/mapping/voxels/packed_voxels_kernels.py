"""Kernels of packed_voxels.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.bit_slices import ONE, count_bits, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, UNSEEN


@njit(cache=True, nogil=True, parallel=True)
def find_observed(tsdf, weight, color, observed, colored):
    """Find the voxels with a distance or a weight, and the voxels with a color.

    Args:
        tsdf: The stored distances (B, 512).
        weight: The stored weights (B, 512).
        color: The packed colors (B, 512).
        observed: The output (B, 8), the voxels with a distance or a weight as bits.
        colored: The output (B, 8), the voxels with a color as bits.
    """
    for block in prange(len(observed)):
        for z in range(BLOCK_SIDE):
            seen = painted = np.uint64(0)
            for n in range(64):
                i = 64 * z + n
                seen |= np.uint64((tsdf[block, i] != UNSEEN) | (weight[block, i] != 0)) << np.uint64(n)
                painted |= np.uint64(color[block, i] != 0) << np.uint64(n)
            observed[block, z] = seen
            colored[block, z] = painted


@njit(cache=True, nogil=True, parallel=True)
def count_voxels(words, counts):
    """Write the number of set bits of each block (B, 8) to `counts` (B,)."""
    for block in prange(len(words)):
        counts[block] = 0
        for z in range(BLOCK_SIDE):
            counts[block] += count_bits(words[block, z])


@njit(cache=True, nogil=True, parallel=True)
def gather(values, words, starts, packed):
    """Write the values (B, 512) of the voxels in `words` (B, 8) to `packed` (N,).

    The values of a block begin at starts[block].
    """
    for block in prange(len(words)):
        at = starts[block]
        for z in range(BLOCK_SIDE):
            left = words[block, z]
            while left:
                packed[at] = values[block, 64 * z + lowest_bit(left)]
                left &= left - ONE
                at += 1


@njit(cache=True, nogil=True, parallel=True)
def scatter(packed, words, starts, values):
    """Write the values (N,) of gather() to their voxels in `values` (B, 512)."""
    for block in prange(len(words)):
        at = starts[block]
        for z in range(BLOCK_SIDE):
            left = words[block, z]
            while left:
                values[block, 64 * z + lowest_bit(left)] = packed[at]
                left &= left - ONE
                at += 1
