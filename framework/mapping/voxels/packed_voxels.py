"""Voxels in map files: only the observed ones, which are a half to two thirds of all voxels.

Measured distances, weights and colors contain little redundancy. Compression would save a sixth of their size, and take
a hundred times as long.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from framework.data import Array, Int64, check_array
from framework.mapping.voxels.packed_voxels_kernels import count_voxels, find_observed, gather, scatter
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE

STORED_VOXELS = ("tsdf", "weight", "color")  # arrays that are not compressed
Bits = npt.NDArray[np.uint64]


class PackedVoxels(NamedTuple):
    """The voxels of B blocks. Bit n of word z represents voxel 64 z + n of a block."""

    observed: Bits  # (B, 8) voxels with a distance and a weight
    colored: Bits  # (B, 8) voxels with a color
    tsdf: npt.NDArray[np.int16]  # (N,) stored distances of the observed voxels
    weight: npt.NDArray[np.uint16]  # (N,) stored weights of the observed voxels
    color: npt.NDArray[np.uint32]  # (M,) packed colors of the colored voxels


def pack_voxels(voxels: VoxelGrid) -> PackedVoxels:
    """Return the observed voxels of a grid."""
    tsdf, weight, color = (
        array[: voxels.block_count] for array in (voxels.grid.tsdf, voxels.grid.weight, voxels.grid.color)
    )
    observed, colored = np.empty((2, voxels.block_count, BLOCK_SIDE), np.uint64)
    find_observed(tsdf, weight, color, observed, colored)
    return PackedVoxels(
        observed, colored, _gathered(tsdf, observed), _gathered(weight, observed), _gathered(color, colored)
    )


def unpack_voxels(packed: PackedVoxels, voxels: VoxelGrid) -> None:
    """Write voxels to the first blocks of a grid, whose voxels are unobserved."""
    observed_starts, colored_starts = starts_of(packed.observed)[:-1], starts_of(packed.colored)[:-1]
    scatter(packed.tsdf, packed.observed, observed_starts, voxels.grid.tsdf)
    scatter(packed.weight, packed.observed, observed_starts, voxels.grid.weight)
    scatter(packed.color, packed.colored, colored_starts, voxels.grid.color)


def checked_voxels(arrays: dict[str, Any]) -> PackedVoxels:
    """Return the voxels in the arrays of a map file.

    Raises:
        DataError: If an array has the wrong type or length.
    """
    packed = PackedVoxels(**{name: arrays[name] for name in PackedVoxels._fields})
    for name in ("observed", "colored"):
        check_array(name, arrays[name], (len(arrays["block_coords"]), BLOCK_SIDE), np.uint64)
    observed, colored = (int(starts_of(words)[-1]) for words in (packed.observed, packed.colored))
    check_array("tsdf", packed.tsdf, (observed,), np.int16)
    check_array("weight", packed.weight, (observed,), np.uint16)
    check_array("color", packed.color, (colored,), np.uint32)
    return packed


def starts_of(words: Bits) -> Int64:
    """Return the number (B + 1,) of set bits before each block (B, 8), and in all blocks."""
    counts = np.empty(len(words), np.int64)
    count_voxels(words, counts)
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])


def _gathered(values: Array, words: Bits) -> Any:
    starts = starts_of(words)
    packed = np.empty(starts[-1], values.dtype)
    gather(values, words, starts[:-1], packed)
    return packed
