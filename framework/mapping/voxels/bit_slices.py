"""Bit operations on slices of 8 x 8 voxels.

A slice is a 64-bit word. Voxel (x, y) is bit 8 y + x. Shifts of a word compare 64 voxels with their neighbors at once.
"""

from __future__ import annotations

import numpy as np

from framework.mapping.voxels.voxel_grid_kernels import device

ONE = np.uint64(1)
_EIGHT = np.uint64(8)
_TO_LAST_COLUMN = np.uint64(7)
_TO_LAST_ROW = np.uint64(56)
_FIRST_COLUMN = np.uint64(0x0101010101010101)
_LAST_COLUMN = np.uint64(0x8080808080808080)


@device
def count_bits(word):
    """Return the number of set bits."""
    # LLVM compiles this idiom to one instruction
    word -= (word >> ONE) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int32((word * _FIRST_COLUMN) >> _TO_LAST_ROW)


@device
def lowest_bit(word):
    """Return the index of the lowest set bit."""
    return count_bits((word & (~word + ONE)) - ONE)


@device
def ahead_x(word, beyond):
    """Return the slice shifted so that (x, y) holds the bit of (x + 1, y).

    The last column comes from `beyond`, the slice of the next block along x.
    """
    return ((word & ~_FIRST_COLUMN) >> ONE) | ((beyond & _FIRST_COLUMN) << _TO_LAST_COLUMN)


@device
def ahead_y(word, beyond):
    """Return the slice shifted so that (x, y) holds the bit of (x, y + 1).

    The last row comes from `beyond`, the slice of the next block along y.
    """
    return (word >> _EIGHT) | (beyond << _TO_LAST_ROW)


@device
def behind_x(word, before):
    """Return the slice shifted so that (x, y) holds the bit of (x - 1, y).

    The first column comes from `before`, the slice of the previous block along x.
    """
    return ((word & ~_LAST_COLUMN) << ONE) | ((before & _LAST_COLUMN) >> _TO_LAST_COLUMN)


@device
def behind_y(word, before):
    """Return the slice shifted so that (x, y) holds the bit of (x, y - 1).

    The first row comes from `before`, the slice of the previous block along y.
    """
    return (word << _EIGHT) | (before >> _TO_LAST_ROW)
