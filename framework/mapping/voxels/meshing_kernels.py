"""Kernels of meshing.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.bit_slices import ONE, ahead_x, ahead_y, behind_x, behind_y, count_bits, lowest_bit
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS, NO_LOOK_UP, UNSEEN, device, find_block
from framework.mapping.voxels.voxel_walk import voxel_number


@device
def _blocks_before(grid, block, out):
    """Find the eight blocks at offset 0 or -1 along each axis from a block, -1 = not allocated."""
    key, region = NO_LOOK_UP
    bx, by, bz = grid.block_coords[block, 0], grid.block_coords[block, 1], grid.block_coords[block, 2]
    for o in range(8):
        out[o], key, region = find_block(grid, bx - (o & 1), by - ((o >> 1) & 1), bz - (o >> 2), key, region)


@njit(cache=True, nogil=True, parallel=True)
def pack(tsdf, blocks, inside, seen):
    """Pack the signs of the distances and the observed voxels of blocks into bits.

    Args:
        tsdf: The stored distances (B, 512).
        blocks: The blocks to update.
        inside: The output (B + 1, 8); a bit is 1 if the distance is negative.
        seen: The output (B + 1, 8); a bit is 1 if the voxel was observed.
    """
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
    """Set `stale` (B,) to True for blocks with a cell that has a corner in a changed block."""
    for b in prange(len(changed)):
        before = np.empty(8, np.int32)
        _blocks_before(grid, changed[b], before)
        for o in range(8):
            if before[o] >= 0:
                stale[before[o]] = True


@device
def _any_and_all(words, around, z):
    """Return, as bits, the cells with any corner set and the cells with all corners set in slice z.

    Here, the corners are the four voxels of the cell in the slice. Slice 8 is slice 0 of the next block. `around` are
    the eight blocks at offset 0 or +1 along each axis.
    """
    up = 4 * (z >> 3)
    z &= 7
    here, block_x = words[around[up], z], words[around[up + 1], z]
    block_y, block_xy = words[around[up + 2], z], words[around[up + 3], z]
    right, below = ahead_x(here, block_x), ahead_y(here, block_y)
    across = ahead_x(below, ahead_y(block_x, block_xy))
    return here | right | below | across, here & right & below & across


@device
def _cell_corners(tsdf, around, x, y, z, corners):
    """Read the stored distances at the eight corners of cell (x, y, z) of a block, x fastest."""
    for c in range(8):
        i, j, k = x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)
        corners[c] = tsdf[around[(i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)], voxel_number(i, j, k)]


@njit(cache=True, nogil=True, parallel=True)
def find_cells(grid, blocks, inside, seen, most_jump, cells):
    """Find the cells with a vertex in the given blocks, as bits (B + 1, 8).

    A cell has no vertex if its distances differ by more than `most_jump`, in stored units.
    """
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
def number_slices(cells, starts):
    """Write the index of the first vertex of each slice to `starts` (B, 8), and return the number of vertices."""
    total = 0
    for block in range(len(starts)):
        for z in range(BLOCK_SIDE):
            starts[block, z] = total
            total += count_bits(cells[block, z])
    return total


@device
def _crossing(a, b):
    """Return (1, position between a and b) of a zero crossing, or (0, 0) without a crossing."""
    crosses = (a ^ b) < 0
    where = np.float32(a) / np.float32(a - b if crosses else 1)
    return (np.float32(1.0), where) if crosses else (np.float32(0.0), np.float32(0.0))


@device
def _cell_vertex(corners):
    """Return the mean (x, y, z) of the zero crossings on the edges of a cell, in voxels."""
    x = y = z = crossings = np.float32(0.0)
    for edge in range(4):  # along each axis, at (u, v) along the other two axes
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
def place_vertices(grid, stale, cells, starts, old_starts, old, vertices, voxels):
    """Compute the vertices of stale blocks, and copy all other vertices from the old surface.

    Args:
        grid: The voxel grid.
        stale: The blocks (B,) to recompute.
        cells: The cells (B + 1, 8) with a vertex, as bits.
        starts: The index (B, 8) of the first vertex of each slice.
        old_starts: The indices (B, 8) in the old surface.
        old: The old surface.
        vertices: The output (V, 3) in the world frame, m.
        voxels: The output (V,), the voxel nearest to each vertex, as block * 512 + index in the block.
    """
    tsdf, block_coords, voxel_size = grid.tsdf, grid.block_coords, grid.voxel_size
    half = np.float32(0.5)
    old_vertices, old_voxels = old.vertices, old.voxels
    for block in prange(len(starts)):
        if not stale[block]:
            start, stop, source = starts[block, 0], starts[block, 0], old_starts[block, 0]
            for z in range(BLOCK_SIDE):
                stop += count_bits(cells[block, z])
            for v in range(stop - start):
                for c in range(3):
                    vertices[start + v, c] = old_vertices[source + v, c]
                voxels[start + v] = old_voxels[source + v]
            continue
        corners = np.empty(8, np.int32)
        around = grid.neighbors[block]
        v = starts[block, 0]
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
    """Return the edges with a quad along x, y and z, as bits, from the voxels of slice z.

    An edge has a quad if its ends have different signs and its four cells have a vertex. `around` and `before` are the
    neighbors of the block on the positive and the negative side.
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
    """Write the number of quads of each block to `counts` (B,)."""
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
def _vertex(cells, starts, before, x, y, z):
    """Return the vertex index of cell (x, y, z) of a block, where -1 refers to the previous block."""
    block = before[(x < 0) + 2 * (y < 0) + 4 * (z < 0)]
    n = np.uint64((y & 7) * 8 + (x & 7))
    return starts[block, z & 7] + count_bits(cells[block, z & 7] & ((ONE << n) - ONE))


@njit(cache=True, nogil=True, parallel=True)
def write_triangles(grid, inside, cells, starts, quad_starts, counts, triangles):
    """Write two triangles for each quad to `triangles` (F, 3).

    The triangles of a block begin at row 2 * quad_starts[block].
    """
    for block in prange(len(counts)):
        if counts[block] == 0:
            continue
        before = np.empty(8, np.int32)
        around = grid.neighbors[block]
        _blocks_before(grid, block, before)
        t = 2 * quad_starts[block]
        for z in range(BLOCK_SIDE):
            edges = _find_quads(inside, cells, around, before, z)
            for axis in range(3):
                left = edges[axis]
                # the cells around the edge are one step back along the other two axes, b and c
                bx, by, bz = axis == 2, axis == 0, axis == 1
                cx, cy, cz = axis == 1, axis == 2, axis == 0
                while left:
                    n = lowest_bit(left)
                    left &= left - ONE
                    x, y = n & 7, n >> 3
                    p = _vertex(cells, starts, before, x, y, z)
                    q = _vertex(cells, starts, before, x - bx, y - by, z - bz)
                    r = _vertex(cells, starts, before, x - bx - cx, y - by - cy, z - bz - cz)
                    s = _vertex(cells, starts, before, x - cx, y - cy, z - cz)
                    if not (inside[block, z] >> np.uint64(n)) & ONE:
                        q, s = s, q
                    triangles[t, 0], triangles[t, 1], triangles[t, 2] = p, q, r
                    triangles[t + 1, 0], triangles[t + 1, 1], triangles[t + 1, 2] = p, r, s
                    t += 2
