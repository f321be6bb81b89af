"""The surface of the map as a triangle mesh, by surface nets (Gibson 1998).

A cell is the cube between eight neighbouring voxels. A cell whose corners change sign gets one vertex, the mean of the
zero crossings on its edges; an edge that changes sign joins the vertices of the four cells around it in a quad.
Compared with marching cubes: no table, half the vertices, better shaped triangles, and every vertex lies within its
cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.data import Bool, Float32, Int32, UInt8
from framework.mapping.evidence import Evidence, best_class, best_counted_instance
from framework.mapping.voxel_grid import BLOCK_SIDE, BLOCK_VOXELS, UNSEEN, Grid, find_block, unpack_color
from framework.mapping.voxel_walk import voxel_number

NO_VERTEX = -1
# A cell whose corners differ by more voxels of distance than this lies on a silhouette seen from one side, between a
# truncated free voxel and a truncated hidden one. Surfaces reach 1 / cos of the slant at which they were seen, so the
# bound is wide.
MAX_JUMP = 8.0


@njit(cache=True, nogil=True, forceinline=True)
def _neighbours(grid, block, side, out):
    """The numbers of the 2x2x2 blocks at offsets 0 or `side` (+1 or -1) along x, y, z, into `out` (8,); -1 = none."""
    key = np.int64(-2)
    region = np.int32(-1)
    bx, by, bz = grid.block_coords[block, 0], grid.block_coords[block, 1], grid.block_coords[block, 2]
    for o in range(8):
        out[o], key, region = find_block(
            grid, bx + side * (o & 1), by + side * ((o >> 1) & 1), bz + side * (o >> 2), key, region
        )


@njit(cache=True, nogil=True, forceinline=True)
def _cell_corners(grid, around, x, y, z, distance):
    """Distances (8,) m at the corners of a block's cell (x, y, z); False when one was never seen or lies off a
    silhouette.
    """
    least = np.float32(np.inf)
    most = np.float32(-np.inf)
    for corner in range(8):
        i, j, k = x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2)
        block = around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)]
        if block < 0:
            return False
        stored = grid.tsdf[block, voxel_number(i, j, k)]
        if stored == UNSEEN:
            return False
        distance[corner] = np.float32(stored) * grid.tsdf_unit
        least = min(least, distance[corner])
        most = max(most, distance[corner])
    return least < np.float32(0.0) <= most and most - least < np.float32(MAX_JUMP) * grid.voxel_size


@njit(cache=True, nogil=True, forceinline=True)
def _cell_vertex(distance, out):
    """The mean zero crossing of the twelve edges of a cell, in voxels from its first corner, into `out` (3,)."""
    out[:] = 0
    crossings = 0
    for axis in range(3):
        bit = 1 << axis
        for corner in range(8):
            if corner & bit:
                continue
            a, b = distance[corner], distance[corner | bit]
            if (a < 0) != (b < 0):
                t = a / (a - b)
                for c in range(3):
                    out[c] += np.float32((corner >> c) & 1) + (t if c == axis else np.float32(0.0))
                crossings += 1
    for c in range(3):
        out[c] /= np.float32(crossings)


@njit(cache=True, nogil=True, parallel=True)
def _find_vertices(grid, blocks, cell_vertex, counts):
    """Numbers the vertices within each block, in cell order, into cell_vertex (B, 512); counts (B,)."""
    for block in prange(blocks):
        around = np.empty(8, np.int32)
        distance = np.empty(8, np.float32)
        _neighbours(grid, block, 1, around)
        count = 0
        for n in range(BLOCK_VOXELS):
            cell_vertex[block, n] = NO_VERTEX
            if _cell_corners(grid, around, n & 7, (n >> 3) & 7, n >> 6, distance):
                cell_vertex[block, n] = count
                count += 1
        counts[block] = count


@njit(cache=True, nogil=True, parallel=True)
def _place_vertices(grid, evidence, counts, first, cell_vertex, vertices, colors, instance_ids, class_ids):
    """Positions and labels of the vertices; those of a block start at first[block]. Labels are the nearest voxel's."""
    for block in prange(len(first)):
        around = np.empty(8, np.int32)
        distance = np.empty(8, np.float32)
        place = np.empty(3, np.float32)
        _neighbours(grid, block, 1, around)
        for n in range(BLOCK_VOXELS):
            if cell_vertex[block, n] == NO_VERTEX:
                continue
            x, y, z = n & 7, (n >> 3) & 7, n >> 6
            _cell_corners(grid, around, x, y, z, distance)
            _cell_vertex(distance, place)
            i = x + int(place[0] + np.float32(0.5))
            j = y + int(place[1] + np.float32(0.5))
            k = z + int(place[2] + np.float32(0.5))
            nearest = around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)]
            m = voxel_number(i, j, k)
            target = first[block] + cell_vertex[block, n]
            vertices[target, 0] = (grid.block_coords[block, 0] * BLOCK_SIDE + x + place[0]) * grid.voxel_size
            vertices[target, 1] = (grid.block_coords[block, 1] * BLOCK_SIDE + y + place[1]) * grid.voxel_size
            vertices[target, 2] = (grid.block_coords[block, 2] * BLOCK_SIDE + z + place[2]) * grid.voxel_size
            red, green, blue = unpack_color(grid.color[nearest, m])
            colors[target, 0], colors[target, 1], colors[target, 2] = red / 4, green / 4, blue / 4
            row = grid.label_row[nearest]
            instance_ids[target] = best_counted_instance(evidence, row, m, counts) if row >= 0 else 0
            class_ids[target] = best_class(evidence, row, m) if row >= 0 else -1


@njit(cache=True, nogil=True, forceinline=True)
def _edge_quad(grid, around, before, cell_vertex, first, n, axis, quad):
    """The vertices (4,) around the edge from voxel n of a block along `axis`; 0 = no quad, else +1 or -1, its winding.

    `around` and `before` are the block's neighbours on the positive and on the negative side.
    """
    x, y, z = n & 7, (n >> 3) & 7, n >> 6
    here = grid.tsdf[around[0], n]
    i, j, k = x + (axis == 0), y + (axis == 1), z + (axis == 2)
    next_block = around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)]
    if next_block < 0:
        return 0
    there = grid.tsdf[next_block, voxel_number(i, j, k)]
    if (here < 0) == (there < 0):
        return 0
    b, c = (axis + 1) % 3, (axis + 2) % 3
    for corner in range(4):
        # cells (0,0), (1,0), (1,1), (0,1) steps back along the axes b and c: once round the edge
        back_b = 1 if corner in (1, 2) else 0
        back_c = 1 if corner >= 2 else 0
        p = x - (back_b if b == 0 else 0) - (back_c if c == 0 else 0)
        q = y - (back_b if b == 1 else 0) - (back_c if c == 1 else 0)
        r = z - (back_b if b == 2 else 0) - (back_c if c == 2 else 0)
        block = before[(p < 0) + 2 * (q < 0) + 4 * (r < 0)]
        if block < 0:
            return 0
        vertex = cell_vertex[block, voxel_number(p, q, r)]
        if vertex == NO_VERTEX:
            return 0
        quad[corner] = first[block] + vertex
    return 1 if here < 0 else -1


@njit(cache=True, nogil=True, parallel=True)
def _make_quads(grid, first, cell_vertex, fill, quad_first, counts, triangles):
    """fill False: counts (B,) the quads of each block. fill True: writes their triangles from 2 * quad_first[block]
    on.
    """
    for block in prange(len(first)):
        around = np.empty(8, np.int32)
        before = np.empty(8, np.int32)
        quad = np.empty(4, np.int32)
        _neighbours(grid, block, 1, around)
        _neighbours(grid, block, -1, before)
        count = 0
        for n in range(BLOCK_VOXELS):
            for axis in range(3):
                winding = _edge_quad(grid, around, before, cell_vertex, first, n, axis, quad)
                if winding == 0:
                    continue
                if fill:
                    t = 2 * (quad_first[block] + count)
                    second, fourth = (quad[1], quad[3]) if winding > 0 else (quad[3], quad[1])
                    triangles[t, 0], triangles[t, 1], triangles[t, 2] = quad[0], second, quad[2]
                    triangles[t + 1, 0], triangles[t + 1, 1], triangles[t + 1, 2] = quad[0], quad[2], fourth
                count += 1
        counts[block] = count


def extract_mesh(
    grid: Grid, block_count: int, evidence: Evidence, counts: Bool
) -> tuple[Float32, Int32, UInt8, Int32, Int32]:
    """(vertices (V, 3) m, triangles (F, 3), colors (V, 3), instance ids (V,), class ids (V,)) of the first blocks.

    Only instances with counts[id] are named; where another one is likelier, the likeliest that counts is. Triangles
    face the side that the surface was seen from. The order of vertices depends on the map alone.
    """
    cell_vertex = np.empty((block_count, BLOCK_VOXELS), np.int32)
    sizes = np.zeros(block_count, np.int32)
    _find_vertices(grid, block_count, cell_vertex, sizes)
    first = _starts(sizes)
    total = int(sizes.sum())
    vertices = np.empty((total, 3), np.float32)
    colors = np.empty((total, 3), np.uint8)
    instance_ids = np.empty(total, np.int32)
    class_ids = np.empty(total, np.int32)
    _place_vertices(grid, evidence, counts, first, cell_vertex, vertices, colors, instance_ids, class_ids)
    triangles = np.empty((0, 3), np.int32)
    _make_quads(grid, first, cell_vertex, False, first, sizes, triangles)
    triangles = np.empty((2 * int(sizes.sum()), 3), np.int32)
    _make_quads(grid, first, cell_vertex, True, _starts(sizes), sizes, triangles)
    return vertices, triangles, colors, instance_ids, class_ids


def _starts(sizes: Int32) -> Int32:
    """Where each block's share begins: the exclusive prefix sum."""
    return (np.cumsum(sizes) - sizes).astype(np.int32)
