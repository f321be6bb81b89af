"""The surface of the map as a triangle mesh, by surface nets (Gibson 1998), kept up to date block by block.

A cell is the cube between eight neighbouring voxels. A cell whose corners change sign gets one vertex, the mean of the
zero crossings on its edges; an edge that changes sign joins the vertices of the four cells around it in a quad.
Compared with marching cubes: no table, half the vertices, better shaped triangles, and every vertex lies within its
cell. Compared with dual contouring, which looks for the corner that the crossings' normals meet in: the mean is farther
from the surface at edges (95th percentile 0.28 of a voxel, not 0.23, in an exact room), and nearer everywhere once the
depth has a Kinect's noise (median 0.085, not 0.107).

Few voxels are near the surface, so the search runs on bits, 64 voxels at once; only cells with a vertex are ever
visited one by one, and a vertex is numbered by counting the bits before its own.

Bytes: 192 a block of words and 32 of numbers, 16 a vertex and 12 a triangle, kept between updates. The vertices of a
block are placed again when one of its voxels, or of those that its cells share with the next blocks, changed; the
others are copied. What comes out depends on the grid alone, not on when it was asked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Float32, Int32
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

# A cell whose corners differ by more voxels of distance than this lies on a silhouette seen from one side, between a
# truncated free voxel and a truncated hidden one. Surfaces reach 1 / cos of the slant at which they were seen, so the
# bound is wide.
MAX_JUMP = 8.0


class UnlabeledMesh(NamedTuple):
    """A mesh without colours and labels: `vertex_labels` has those."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3), facing the side that the surface was seen from
    voxels: Int32  # (V,) block * 512 + number within the block


class SurfaceNets:
    """The surface of a grid. `changed` notes the blocks that were written, `extract` brings the surface up to date."""

    def __init__(self, voxels: VoxelGrid) -> None:
        self.voxels = voxels
        # of voxels and cells, a bit each, (B + 1, 8); the last row is that of a block that is absent, number -1
        self._inside = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._seen = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._cells = np.zeros((1, BLOCK_SIDE), np.uint64)
        self._first = np.zeros((0, BLOCK_SIDE), np.int32)  # number of the first vertex of each slice
        self._changed = np.zeros(0, np.bool_)  # (B,)
        self._surface = UnlabeledMesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty(0, np.int32))

    def changed(self, blocks: Int32) -> None:
        """Notes that voxels of these blocks were written. Blocks that are new since `extract` need not be named."""
        known = blocks[blocks < len(self._changed)]
        self._changed[known] = True

    def extract(self) -> UnlabeledMesh:
        """The surface as the grid is now. The order of vertices and triangles depends on the grid alone."""
        grid, count = self.voxels.grid, self.voxels.block_count
        self._grow(count)
        changed = np.flatnonzero(self._changed).astype(np.int32)
        if len(changed) == 0:
            return self._surface
        inside, seen, cells, old_first, old = self._inside, self._seen, self._cells, self._first, self._surface
        pack(grid.tsdf, changed, inside, seen)
        stale = np.zeros(count, np.bool_)
        mark_stale(grid, changed, stale)
        most_jump = np.int32(MAX_JUMP * grid.voxel_size / grid.tsdf_unit)
        blocks = np.flatnonzero(stale).astype(np.int32)
        find_cells(grid, blocks, inside, seen, most_jump, cells)
        first = np.empty((count, BLOCK_SIDE), np.int32)
        total = number_slices(cells, first)
        vertices = np.empty((total, 3), np.float32)
        voxels = np.empty(total, np.int32)
        place_vertices(grid, stale, cells, first, old_first, old, vertices, voxels)
        quads = np.empty(count, np.int32)
        count_quads(grid, inside, cells, quads)
        ends = np.cumsum(quads)
        triangles = np.empty((2 * int(ends[-1]), 3), np.int32)
        write_triangles(grid, inside, cells, first, (ends - quads).astype(np.int32), quads, triangles)
        self._first = first
        self._changed[:] = False
        self._surface = UnlabeledMesh(vertices, triangles, voxels)
        return self._surface

    def _grow(self, count: int) -> None:
        """Makes room for the grid's new blocks, which are all new surface."""
        self._changed = np.concatenate([self._changed, np.ones(count - len(self._changed), np.bool_)])
        if count + 1 > len(self._inside):
            capacity = len(self.voxels.grid.block_coords) + 1
            self._inside, self._seen, self._cells = (
                grown(words, capacity, zeros=True) for words in (self._inside, self._seen, self._cells)
            )
