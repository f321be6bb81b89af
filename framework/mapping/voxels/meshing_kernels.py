"""Kernels of meshing.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.mapping.voxels.bit_slices import ONE, ahead_x, ahead_y, behind_x, behind_y, count_bits, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS, UNSEEN, device, find_block
from framework.mapping.voxels.voxel_walk import voxel_number


@device
def _blocks_before(grid, block, out):
    """The numbers of the 2x2x2 blocks at offsets 0 or -1 along x, y, z, into `out` (8,); -1 = none."""
    key = np.int64(-2)
    region = np.int32(-1)
    bx, by, bz = grid.block_coords[block, 0], grid.block_coords[block, 1], grid.block_coords[block, 2]
    for o in range(8):
        out[o], key, region = find_block(grid, bx - (o & 1), by - ((o >> 1) & 1), bz - (o >> 2), key, region)


@njit(cache=True, nogil=True, parallel=True)
def pack(tsdf, blocks, inside, seen):
    """Packs the signs of the blocks' voxels into `inside` (B + 1, 8) and what was seen of them into `seen`."""
    for b in prange(len(blocks)):
        block = blocks[b]
        for z in range(BLOCK_SIDE):
            negative = np.uint64(0)
            known = np.uint64(0)
            for n in range(64):
                stored = tsdf[block, 64 * z + n]
                negative |= np.uint64(stored < 0) << np.uint64(n)
                known |= np.uint64(stored != UNSEEN) << np.uint64(n)
            inside[block, z] = negative
            seen[block, z] = known


@njit(cache=True, nogil=True, parallel=True)
def mark_stale(grid, changed, stale):
    """Marks in `stale` (B,) the blocks with a cell that has a corner in a changed block."""
    for b in prange(len(changed)):
        before = np.empty(8, np.int32)
        _blocks_before(grid, changed[b], before)
        for o in range(8):
            if before[o] >= 0:
                stale[before[o]] = True


@device
def _any_and_all(words, around, z):
    """Which cells of slice z have any of their four corners in that slice set, and which have all."""
    up = 4 * (z >> 3)
    z &= 7
    here, block_x = words[around[up], z], words[around[up + 1], z]
    block_y, block_xy = words[around[up + 2], z], words[around[up + 3], z]
    right, below = ahead_x(here, block_x), ahead_y(here, block_y)
    across = ahead_x(below, ahead_y(block_x, block_xy))
    return here | right | below | across, here & right & below & across


@device
def _cell_corners(tsdf, around, x, y, z, corners):
    """The stored distances (8,) at the corners of a block's cell (x, y, z)."""
    for c in range(8):
        i, j, k = x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)
        corners[c] = tsdf[around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)], voxel_number(i, j, k)]


@njit(cache=True, nogil=True, parallel=True)
def find_cells(grid, blocks, inside, seen, most_jump, cells):
    """Packs the cells of the blocks that have a vertex into `cells` (B + 1, 8)."""
    tsdf = grid.tsdf
    for b in prange(len(blocks)):
        block = blocks[b]
        corners = np.empty(8, np.int32)
        around = grid.neighbors[block]
        any_low, all_low = _any_and_all(inside, around, 0)
        _, seen_low = _any_and_all(seen, around, 0)
        for z in range(BLOCK_SIDE):
            any_high, all_high = _any_and_all(inside, around, z + 1)
            _, seen_high = _any_and_all(seen, around, z + 1)
            candidates = (any_low | any_high) & ~(all_low & all_high) & seen_low & seen_high
            found = candidates
            while candidates:
                n = lowest_bit(candidates)
                candidates &= candidates - ONE
                _cell_corners(tsdf, around, n & 7, n >> 3, z, corners)
                lowest = highest = corners[0]
                for c in range(1, 8):
                    lowest, highest = min(lowest, corners[c]), max(highest, corners[c])
                if highest - lowest > most_jump:
                    found ^= ONE << np.uint64(n)
            cells[block, z] = found
            any_low, all_low, seen_low = any_high, all_high, seen_high


@njit(cache=True, nogil=True)
def number_slices(cells, first):
    """The number of the first vertex of each slice into `first` (B, 8); returns how many there are."""
    total = 0
    for block in range(len(first)):
        for z in range(BLOCK_SIDE):
            first[block, z] = total
            total += count_bits(cells[block, z])
    return total


@device
def _crossing(a, b):
    """(1, where) on an edge whose ends have the distances a and b of different sign, else (0, 0). Without a branch."""
    crosses = (a ^ b) < 0
    where = np.float32(a) / np.float32(a - b if crosses else 1)
    return (np.float32(1.0), where) if crosses else (np.float32(0.0), np.float32(0.0))


@device
def _cell_vertex(corners):
    """(x, y, z), in voxels from the first corner: the mean zero crossing of the twelve edges of a cell."""
    x = y = z = crossings = np.float32(0.0)
    for edge in range(4):  # along each axis, at (u, v) of the two others
        u, v = np.float32(edge & 1), np.float32(edge >> 1)
        crosses, where = _crossing(corners[2 * edge], corners[2 * edge + 1])
        x, y, z, crossings = x + where, y + crosses * u, z + crosses * v, crossings + crosses
        low = (edge & 1) + 4 * (edge >> 1)
        crosses, where = _crossing(corners[low], corners[low + 2])
        x, y, z, crossings = x + crosses * u, y + where, z + crosses * v, crossings + crosses
        crosses, where = _crossing(corners[edge], corners[edge + 4])
        x, y, z, crossings = x + crosses * u, y + crosses * v, z + where, crossings + crosses
    return x / crossings, y / crossings, z / crossings


@njit(cache=True, nogil=True, parallel=True)
def place_vertices(grid, stale, cells, first, old_first, old, vertices, voxels):
    """Places the vertices of the stale blocks, and copies those of the others from the `old` surface."""
    tsdf, block_coords, voxel_size = grid.tsdf, grid.block_coords, grid.voxel_size
    half = np.float32(0.5)
    old_vertices, old_voxels = old.vertices, old.voxels
    for block in prange(len(first)):
        if not stale[block]:
            start, stop, source = first[block, 0], first[block, 0], old_first[block, 0]
            for z in range(BLOCK_SIDE):
                stop += count_bits(cells[block, z])
            for v in range(stop - start):
                for c in range(3):
                    vertices[start + v, c] = old_vertices[source + v, c]
                voxels[start + v] = old_voxels[source + v]
            continue
        corners = np.empty(8, np.int32)
        around = grid.neighbors[block]
        v = first[block, 0]
        for z in range(BLOCK_SIDE):
            left = cells[block, z]
            while left:
                n = lowest_bit(left)
                left &= left - ONE
                x, y = n & 7, n >> 3
                _cell_corners(tsdf, around, x, y, z, corners)
                px, py, pz = _cell_vertex(corners)
                vertices[v, 0] = (np.float32(block_coords[block, 0] * BLOCK_SIDE + x) + px) * voxel_size
                vertices[v, 1] = (np.float32(block_coords[block, 1] * BLOCK_SIDE + y) + py) * voxel_size
                vertices[v, 2] = (np.float32(block_coords[block, 2] * BLOCK_SIDE + z) + pz) * voxel_size
                i, j, k = x + int(px + half), y + int(py + half), z + int(pz + half)
                nearest = around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)]
                voxels[v] = nearest * BLOCK_VOXELS + voxel_number(i, j, k)
                v += 1


@device
def _find_quads(inside, cells, around, before, z):
    """The edges from the voxels of slice z along x, y and z that a quad goes round: three words.

    They change sign, and the four cells around each have a vertex. `around` and `before` are the block's neighbours on
    the positive and on the negative side.
    """
    block = around[0]
    here = inside[block, z]
    above = inside[block, z + 1] if z < 7 else inside[around[4], 0]
    change_x = here ^ ahead_x(here, inside[around[1], z])
    change_y = here ^ ahead_y(here, inside[around[2], z])
    change_z = here ^ above
    down, below = (0, z - 1) if z > 0 else (4, 7)
    cell, cell_x = cells[block, z], cells[before[1], z]
    cell_y, cell_xy = cells[before[2], z], cells[before[3], z]
    low, low_x = cells[before[down], below], cells[before[down + 1], below]
    low_y = cells[before[down + 2], below]
    pair_x = cell & behind_x(cell, cell_x)
    pair_y = cell & behind_y(cell, cell_y)
    low_pair_x = low & behind_x(low, low_x)
    low_pair_y = low & behind_y(low, low_y)
    pair_y_before = cell_x & behind_y(cell_x, cell_xy)
    return (
        change_x & pair_y & low_pair_y,
        change_y & pair_x & low_pair_x,
        change_z & pair_y & behind_x(pair_y, pair_y_before),
    )


@njit(cache=True, nogil=True, parallel=True)
def count_quads(grid, inside, cells, counts):
    """The quads of each block, into `counts` (B,)."""
    for block in prange(len(counts)):
        before = np.empty(8, np.int32)
        counts[block] = 0
        any_cell = np.uint64(0)
        for z in range(BLOCK_SIDE):
            any_cell |= cells[block, z]
        if not any_cell:
            continue
        around = grid.neighbors[block]
        _blocks_before(grid, block, before)
        for z in range(BLOCK_SIDE):
            along_x, along_y, along_z = _find_quads(inside, cells, around, before, z)
            counts[block] += count_bits(along_x) + count_bits(along_y) + count_bits(along_z)


@device
def _vertex(cells, first, before, x, y, z):
    """The number of the vertex of a cell, which may lie one cell before the block."""
    block = before[(x < 0) + 2 * (y < 0) + 4 * (z < 0)]
    n = np.uint64((y & 7) * 8 + (x & 7))
    return first[block, z & 7] + count_bits(cells[block, z & 7] & ((ONE << n) - ONE))


@njit(cache=True, nogil=True, parallel=True)
def write_triangles(grid, inside, cells, first, quad_first, counts, triangles):
    """Two triangles for each quad; those of a block start at 2 * quad_first[block]."""
    for block in prange(len(counts)):
        if counts[block] == 0:
            continue
        before = np.empty(8, np.int32)
        around = grid.neighbors[block]
        _blocks_before(grid, block, before)
        t = 2 * quad_first[block]
        for z in range(BLOCK_SIDE):
            edges = _find_quads(inside, cells, around, before, z)
            for axis in range(3):
                left = edges[axis]
                # the cells around the edge lie one step back along the two other axes, b and c
                bx, by, bz = axis == 2, axis == 0, axis == 1
                cx, cy, cz = axis == 1, axis == 2, axis == 0
                while left:
                    n = lowest_bit(left)
                    left &= left - ONE
                    x, y = n & 7, n >> 3
                    p = _vertex(cells, first, before, x, y, z)
                    q = _vertex(cells, first, before, x - bx, y - by, z - bz)
                    r = _vertex(cells, first, before, x - bx - cx, y - by - cy, z - bz - cz)
                    s = _vertex(cells, first, before, x - cx, y - cy, z - cz)
                    if not (inside[block, z] >> np.uint64(n)) & ONE:
                        q, s = s, q
                    triangles[t, 0], triangles[t, 1], triangles[t, 2] = p, q, r
                    triangles[t + 1, 0], triangles[t + 1, 1], triangles[t + 1, 2] = p, r, s
                    t += 2
