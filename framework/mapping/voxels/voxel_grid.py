"""Voxel hashing: blocks of 8^3 voxels, allocated near observed surfaces.

The method follows Niessner et al., "Real-time 3D Reconstruction at Scale using Voxel Hashing" (2013). The hash table
contains regions of 8^3 blocks, and each region is a dense table of block indices. Successive look-ups are usually in
the same region, so most of them do not access the hash table. Rays skip an empty region in one step.

Voxel (i, j, k) samples the field at the world point (i, j, k) * voxel_size. Voxel (x, y, z) of a block has the index (z
* 8 + y) * 8 + x.

A voxel takes 8 bytes: 2 for the distance, 2 for the weight and 4 for the color. Label evidence takes additional memory;
see evidence_rows.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from framework.data import Int32, UInt8
from framework.errors import MapFullError
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_SIDE,
    BLOCK_VOXELS,
    NO_KEY,
    find_blocks,
    insert_blocks,
    rehash,
)

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]
Element = TypeVar("Element", bound=np.generic)
Made = TypeVar("Made")
MAX_BLOCKS = 2**31 // BLOCK_VOXELS  # maximum number of blocks of a map; voxel indices are 32-bit
REGION_SIDE = 8  # side of a region, blocks
REGION_BLOCKS = REGION_SIDE**3
WEIGHT_ONE = 256  # stored weight of one observation
TSDF_MAX = 32767  # stored value of the maximum truncation distance
MOVED_BYTES = 2**20  # maximum size of rows that are moved at once
FIRST_RESERVED = 1024  # initial capacity, blocks or voxels


class Grid(NamedTuple):
    """The arrays of a voxel grid.

    B and S are the capacities for blocks and regions. Only the first entries are in use.
    """

    voxel_size: np.float32  # m
    tsdf_unit: np.float32  # distance represented by a stored tsdf of 1, m
    table_keys: npt.NDArray[np.int64]  # (T,) packed region coordinates, NO_KEY = free; T is a power of two
    table_regions: Int32  # (T,) region index
    region_coords: Int32  # (S, 3) region coordinates; the first block is at 8 times these
    region_blocks: Int32  # (S, 512) block index, -1 = not allocated
    block_coords: Int32  # (B, 3) block coordinates; the first voxel is at 8 times these
    neighbors: Int32  # (B, 8) blocks at +0 or +1 along x (bit 0), y (bit 1), z (bit 2); -1 = not allocated
    tsdf: npt.NDArray[np.int16]  # (B, 512) signed distance in tsdf_unit, positive in front of the surface, or UNSEEN
    weight: npt.NDArray[np.uint16]  # (B, 512) in 1/256 observations
    color: npt.NDArray[np.uint32]  # (B, 512) packed, see pack_color()
    solid: UInt8  # (B,) 1 = any voxel is behind a surface; rays skip all other blocks
    label_row: Int32  # (B,) row of the block in the label evidence, -1 = none


VOXEL_ARRAYS = ("tsdf", "weight", "color", "solid")  # fields that do not refer to blocks or rows
OF_BLOCKS = Grid._fields[Grid._fields.index("block_coords") :]  # fields of shape (B, ...)


def _free_blocks(count: int) -> dict[str, Any]:
    return {
        "block_coords": np.empty((count, 3), np.int32),
        "neighbors": np.empty((count, 8), np.int32),
        "tsdf": np.empty((count, BLOCK_VOXELS), np.int16),
        "weight": np.empty((count, BLOCK_VOXELS), np.uint16),
        "color": np.empty((count, BLOCK_VOXELS), np.uint32),
        "solid": np.empty(count, np.uint8),
        "label_row": np.empty(count, np.int32),
    }


def reserved(most: int, make: Callable[[int], Made]) -> Made:
    """Return the uninitialized arrays of make(most), which have enough rows to never grow.

    Uninitialized arrays take no memory until they are written. If the address space is limited (Windows, `ulimit -v`),
    return smaller arrays, which can grow.
    """
    first = min(most, FIRST_RESERVED)
    if resource is None or resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY:
        return make(first)
    try:
        return make(most)
    except MemoryError:
        return make(first)


class VoxelGrid:
    """A growing voxel grid.

    The kernels modify its `grid`.
    """

    def __init__(self, voxel_size: float, max_truncation: float, max_blocks: int) -> None:
        self.max_blocks = max_blocks
        self.block_count = 0
        self.region_count = 0
        self.grid = Grid(
            voxel_size=np.float32(voxel_size),
            tsdf_unit=np.float32(max_truncation / TSDF_MAX),
            table_keys=np.full(256, NO_KEY, np.int64),
            table_regions=np.full(256, -1, np.int32),
            region_coords=np.empty((64, 3), np.int32),
            region_blocks=np.empty((64, REGION_BLOCKS), np.int32),
            **reserved(max_blocks, _free_blocks),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without reserved capacity, which may be gigabytes."""
        blocks = {name: getattr(self.grid, name)[: self.block_count] for name in OF_BLOCKS}
        return {**vars(self), "grid": self.grid._replace(**blocks)}

    def like(self, max_blocks: int) -> VoxelGrid:
        """Return an empty grid with voxels of the same size."""
        other = VoxelGrid(float(self.grid.voxel_size), TSDF_MAX * float(self.grid.tsdf_unit), max_blocks)
        other.grid = other.grid._replace(tsdf_unit=self.grid.tsdf_unit)  # exactly
        return other

    def part(self, blocks: Int32) -> VoxelGrid:
        """Return a copy of the blocks (N,), without label rows."""
        other = self.like(max(len(blocks), 1))
        other.allocate(self.grid.block_coords[blocks])
        for name in VOXEL_ARRAYS:
            getattr(other.grid, name)[: len(blocks)] = getattr(self.grid, name)[blocks]
        return other

    def keep(self, blocks: Int32) -> None:
        """Remove all other blocks, and renumber the blocks (N,), which are ascending. Regions remain."""
        numbers = np.full(self.block_count + 1, -1, np.int32)  # of each old block; the last one stands for -1
        numbers[blocks] = np.arange(len(blocks))
        grid = self.grid
        for name in OF_BLOCKS:
            move_forward(getattr(grid, name), blocks)
        self.block_count = len(blocks)
        grid.neighbors[: len(blocks)] = numbers[grid.neighbors[: len(blocks)]]
        grid.region_blocks[: self.region_count] = numbers[grid.region_blocks[: self.region_count]]

    @property
    def byte_count(self) -> int:
        """Size of the arrays in use, bytes. Unused capacity takes no memory."""
        grid = self.grid
        regions = sum(array[: self.region_count].nbytes for array in (grid.region_coords, grid.region_blocks))
        blocks = sum(getattr(grid, name)[: self.block_count].nbytes for name in OF_BLOCKS)
        return int(grid.table_keys.nbytes + grid.table_regions.nbytes + regions + blocks)

    def allocate(self, coords: Int32) -> Int32:
        """Return the block indices (N,) at block coordinates (N, 3).

        Missing blocks are allocated in the given order.

        Raises:
            MapFullError: If more than `max_blocks` are needed. Blocks allocated before the error remain.
        """
        done, blocks = 0, np.empty(len(coords), np.int32)
        while True:
            done, self.region_count, self.block_count = insert_blocks(
                self.grid, coords, done, self.region_count, self.block_count, blocks
            )
            if done == len(coords):
                return blocks
            if self.block_count == self.max_blocks:
                raise MapFullError(
                    f"fuser.max_blocks: expected at most {self.max_blocks} blocks of {BLOCK_SIDE}^3 voxels in the map "
                    f"({self.byte_count / 2**20:.0f} MiB), got at least {self.max_blocks + 1}; raise "
                    "fuser.max_blocks or fuser.voxel_size"
                )
            self._grow()

    def find(self, coords: Int32) -> Int32:
        """Return the block indices (N,) at block coordinates (N, 3), -1 = not allocated."""
        blocks = np.empty(len(coords), np.int32)
        find_blocks(self.grid, coords, blocks)
        return blocks

    def _grow(self) -> None:
        """Double each exhausted capacity."""
        grid = self.grid
        if self.block_count == len(grid.block_coords):
            more = min(max(2 * len(grid.block_coords), FIRST_RESERVED), self.max_blocks)
            longer: dict[str, Any] = {name: grown(getattr(grid, name), more) for name in OF_BLOCKS}
            grid = grid._replace(**longer)
        if self.region_count == len(grid.region_blocks):
            grid = grid._replace(
                region_coords=grown(grid.region_coords, 2 * self.region_count),
                region_blocks=grown(grid.region_blocks, 2 * self.region_count),
            )
        if 2 * (self.region_count + 1) > len(grid.table_keys):
            keys = np.full(2 * len(grid.table_keys), NO_KEY, np.int64)
            regions = np.full(len(keys), -1, np.int32)
            rehash(grid.table_keys, grid.table_regions, keys, regions)
            grid = grid._replace(table_keys=keys, table_regions=regions)
        self.grid = grid


def move_forward(array: npt.NDArray[Any], rows: npt.NDArray[np.integer]) -> None:
    """Move the ascending rows (N,) of an array to its beginning, in small parts."""
    size = max(1, MOVED_BYTES // max(array[:1].nbytes, 1))
    for start in range(0, len(rows), size):
        part = rows[start : start + size]
        array[start : start + len(part)] = array[part]


def grown(array: npt.NDArray[Element], length: int, zeros: bool = False) -> npt.NDArray[Element]:
    """Return a copy of an array with `length` rows.

    New rows are uninitialized, or 0 if `zeros` is True.
    """
    longer = (np.zeros if zeros else np.empty)((length, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer
