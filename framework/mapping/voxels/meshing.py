"""Surface extraction by surface nets (Gibson, 1998).

A cell is the cube between eight neighboring voxels. If the signs of its corners differ, the cell has one vertex, at the
mean of the zero crossings on its edges. The vertices of the four cells around each edge with a sign change form a quad.
Compared with marching cubes, surface nets have half the vertices and better triangle shapes.

The search for cells tests 64 voxels at once as bits of a word. The index of a vertex is the number of set bits before
its own bit.

Updates recompute only the vertices of blocks whose cells have changed. The result depends on the grid alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Bool, Float32, Int32
from framework.mapping.voxels.meshing_kernels import (
    count_quads,
    find_cells,
    mark_stale,
    number_slices,
    pack,
    place_vertices,
    write_triangles,
)
from framework.mapping.voxels.voxel_grid import VoxelGrid, grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE

# Maximum difference between the signed distances at the corners of a cell, voxels. Cells with a larger difference are
# on a silhouette, between free space and hidden space. The limit is high, because distances along the camera axis are
# too large on oblique surfaces.
MAX_JUMP = 8.0


class UnlabeledMesh(NamedTuple):
    """A mesh without colors and labels."""

    vertices: Float32  # (V, 3) m, world frame
    triangles: Int32  # (F, 3) vertex indices; face normals point to the observed side
    voxels: Int32  # (V,) nearest voxel, as block * 512 + index in the block


class SurfaceNets:
    """The surface of a voxel grid, updated block by block."""

    def __init__(self, voxels: VoxelGrid) -> None:
        self.voxels = voxels
        # (B + 1, 8) one bit per voxel or cell; the last row, index -1, represents an absent block
        self._inside = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._seen = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._cells = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._starts = np.zeros((0, BLOCK_SIDE), np.int32)  # index of the first vertex of each slice
        self._changed = np.zeros(0, np.bool_)  # (B,) since the last extraction
        self._not_taken = np.zeros(0, np.bool_)  # (B,) changed since the last call of `take_changed`
        self._surface = UnlabeledMesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty(0, np.int32))

    def changed(self, blocks: Int32) -> None:
        """Mark blocks (A,) whose voxels have changed.

        New blocks need not be marked.
        """
        known = blocks[blocks < len(self._changed)]
        self._changed[known] = self._not_taken[known] = True

    def take_changed(self) -> tuple[Int32, Bool]:
        """Return the first vertex (B + 1,) of each block of the last surface, and the changed blocks.

        The first vertex is followed by the number of vertices. The Boolean array (B,) is True for blocks whose voxels
        have changed since the last call.
        """
        starts = np.append(self._starts[:, 0], np.int32(len(self._surface.vertices)))
        changed, self._not_taken = self._not_taken, np.zeros_like(self._not_taken)
        return starts, changed

    def extract(self) -> UnlabeledMesh:
        """Return the current surface.

        The order of the vertices and triangles depends on the grid alone.
        """
        grid, count = self.voxels.grid, self.voxels.block_count
        self._grow(count)
        changed = np.flatnonzero(self._changed).astype(np.int32)
        if len(changed) == 0:
            return self._surface
        inside, seen, cells, old_starts, old = self._inside, self._seen, self._cells, self._starts, self._surface
        pack(grid.tsdf, changed, inside, seen)
        stale = np.zeros(count, np.bool_)
        mark_stale(grid, changed, stale)
        most_jump = np.int32(MAX_JUMP * grid.voxel_size / grid.tsdf_unit)
        blocks = np.flatnonzero(stale).astype(np.int32)
        find_cells(grid, blocks, inside, seen, most_jump, cells)
        starts = np.empty((count, BLOCK_SIDE), np.int32)
        total = number_slices(cells, starts)
        vertices = np.empty((total, 3), np.float32)
        voxels = np.empty(total, np.int32)
        place_vertices(grid, stale, cells, starts, old_starts, old, vertices, voxels)
        quads = np.empty(count, np.int32)
        count_quads(grid, inside, cells, quads)
        ends = np.cumsum(quads)
        triangles = np.empty((2 * int(ends[-1]), 3), np.int32)
        write_triangles(grid, inside, cells, starts, (ends - quads).astype(np.int32), quads, triangles)
        self._starts = starts
        self._changed[:] = False
        self._surface = UnlabeledMesh(vertices, triangles, voxels)
        return self._surface

    def _grow(self, count: int) -> None:
        """Grow the arrays to the blocks of the grid, and mark the new blocks."""
        new = np.ones(count - len(self._changed), np.bool_)
        self._changed, self._not_taken = np.append(self._changed, new), np.append(self._not_taken, new)
        if count + 1 > len(self._inside):
            capacity = len(self.voxels.grid.block_coords) + 1
            self._inside, self._seen, self._cells = (
                grown(words, capacity, zeros=True) for words in (self._inside, self._seen, self._cells)
            )
