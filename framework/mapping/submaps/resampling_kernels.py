"""Kernels of resampling.py."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.vertex_labels_kernels import most_common
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_SIDE,
    BLOCK_VOXELS,
    COLORED,
    NO_KEY,
    NO_LOOK_UP,
    OUTDATED,
    UNSEEN,
    device,
    find_block,
    pack_color,
    pack_key,
    unpack_color,
)
from framework.mapping.voxels.voxel_walk import voxel_number

MAX_COVERED = 27  # maximum number of blocks that a moved block overlaps: three along each axis
ROUNDING = 1e-6  # voxels, bound of rounding errors
MIN_OBSERVED = 0.5  # minimum fraction of the trilinear weight on observed voxels


class VoxelInstances(NamedTuple):
    """The most likely instances of the voxels of B blocks."""

    labeled: Any  # (512 B,) index of each voxel among the labeled voxels, -1 = not labeled
    instance_ids: Any  # (N,) instance of each labeled voxel, 0 = none
    near: Any  # maximum distance of voting voxels from the surface, in stored units


@njit(cache=True, nogil=True, parallel=True)
def covered_blocks(block_coords, R, t, keys):
    """Write the keys of the blocks that each moved block overlaps to `keys` (B, MAX_COVERED), NO_KEY = none.

    Args:
        block_coords: The block coordinates (B, 3).
        R: The rotation (3, 3) of the motion.
        t: The translation (3,) of the motion, voxels.
        keys: The output.
    """
    half = 0.5 * (BLOCK_SIDE - 1)
    for b in prange(block_coords.shape[0]):
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for axis in range(3):
            center, extent = t[axis], 0.0
            for other in range(3):
                center += R[axis, other] * (block_coords[b, other] * BLOCK_SIDE + half)
                extent += abs(R[axis, other]) * half
            # voxels less than 1 from the moved block can be interpolated from it
            low[axis] = np.int64(np.floor(np.floor(center - extent) / BLOCK_SIDE))
            high[axis] = np.int64(np.floor(np.ceil(center + extent) / BLOCK_SIDE))
        n = 0
        for z in range(low[2], high[2] + 1):
            for y in range(low[1], high[1] + 1):
                for x in range(low[0], high[0] + 1):
                    keys[b, n] = pack_key(x, y, z)
                    n += 1
        for rest in range(n, MAX_COVERED):
            keys[b, rest] = NO_KEY


@device
def _nearby_blocks(source, R, t, coords, nearby):
    """Find the source blocks that a target block can be interpolated from.

    Args:
        source: The voxel grid before the motion.
        R: The rotation (3, 3) from new to old coordinates.
        t: The translation (3,) from new to old coordinates, voxels.
        coords: The coordinates (3,) of the target block.
        nearby: The output (27,), three blocks along each axis, x fastest, -1 = not allocated.

    Returns:
        True if any of the blocks is allocated, and the coordinates of the first one.
    """
    half = 0.5 * (BLOCK_SIDE - 1)
    x, y, z = (BLOCK_SIDE * coords[0] + half, BLOCK_SIDE * coords[1] + half, BLOCK_SIDE * coords[2] + half)
    first = (
        _first_block(R[0, 0], R[0, 1], R[0, 2], t[0], x, y, z),
        _first_block(R[1, 0], R[1, 1], R[1, 2], t[1], x, y, z),
        _first_block(R[2, 0], R[2, 1], R[2, 2], t[2], x, y, z),
    )
    exists = False
    key, region = NO_LOOK_UP
    for c in range(27):
        nearby[c], key, region = find_block(
            source, first[0] + c % 3, first[1] + c // 3 % 3, first[2] + c // 9, key, region
        )
        exists = exists or nearby[c] >= 0
    return exists, first


@device
def _first_block(a, b, c, shift, x, y, z):
    """Return the smallest old block coordinate, along one axis, of a target block with the center (x, y, z)."""
    half = 0.5 * (BLOCK_SIDE - 1) + ROUNDING
    low = a * x + b * y + c * z + shift - half * (abs(a) + abs(b) + abs(c))
    return np.int32(np.int32(np.floor(low)) >> 3)


@device
def _corner_voxels(nearby, first, i, j, k, found):
    """Write the voxels at the corners of a cell to `found`, as block * 512 + index in the block, -1 = none.

    Args:
        nearby: The blocks (27,) around the cell.
        first: The coordinates of the first of these blocks.
        i: The first index of the first corner.
        j: The second index.
        k: The third index.
        found: The output (8,), x fastest.

    Returns:
        True if any of the blocks is allocated.
    """
    n = ((k >> 3) - first[2]) * 9 + ((j >> 3) - first[1]) * 3 + (i >> 3) - first[0]
    block = nearby[n]
    if (i & 7) != 7 and (j & 7) != 7 and (k & 7) != 7:  # most cells are inside one block
        start = block * BLOCK_VOXELS + voxel_number(i, j, k) if block >= 0 else np.int32(-1)
        for c in range(8):
            found[c] = start + (c & 1) + 8 * ((c >> 1) & 1) + 64 * (c >> 2) if block >= 0 else np.int32(-1)
        return block >= 0
    exists = False
    for c in range(8):
        x, y, z = i + (c & 1), j + ((c >> 1) & 1), k + (c >> 2)
        block = nearby[((z >> 3) - first[2]) * 9 + ((y >> 3) - first[1]) * 3 + (x >> 3) - first[0]]
        found[c] = block * BLOCK_VOXELS + voxel_number(x, y, z) if block >= 0 else np.int32(-1)
        exists = exists or block >= 0
    return exists


@device
def _elect(found, portions, tsdf, instances, ids, votes, nearest):
    """Return the corner whose label evidence is copied, by a vote of the corners near the surface.

    Args:
        found: The voxels (8,) at the corners.
        portions: The trilinear weights (8,), 0 = unobserved.
        tsdf: The stored distances of the source voxels.
        instances: The instances of the source voxels.
        ids: A scratch array (8,).
        votes: A scratch array (8,).
        nearest: The corner with the largest weight, which is returned if no corner is near the surface.
    """
    for c in range(8):
        ids[c], votes[c] = 0, 0.0
        if portions[c] > 0.0 and abs(tsdf[found[c]]) <= instances.near:
            labeled = instances.labeled[found[c]]
            ids[c] = instances.instance_ids[labeled] if labeled >= 0 else 0
            votes[c] = portions[c]
    elected, most = most_common(ids, votes)
    return elected if most > 0.0 else nearest


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def resample(source, R, t, target, most_jump, instances, label_source):
    """Resample moved voxels.

    Distances, weights and colors are interpolated trilinearly between observed voxels. If the distances at the corners
    of a cell differ by more than `most_jump`, the nearest voxel is copied, because there is no surface in between.

    Near the surface, the instance is the most common one of the corners, weighted trilinearly, as for vertices. The
    label evidence comes from its corner with the largest weight, and far from the surface from the nearest corner.

    Args:
        source: The voxel grid before the motion.
        R: The rotation (3, 3) from new to old coordinates.
        t: The translation (3,) from new to old coordinates, voxels.
        target: The output grid, whose blocks are allocated and unobserved.
        most_jump: The maximum difference of the distances at the corners, in stored units.
        instances: The instances of the source voxels; empty = no labels.
        label_source: The output (B, 512), the source voxel of the label evidence as block * 512 + index in the block,
            -1 = no observed voxel.
    """
    coords, tsdf, weight, color = target.block_coords, target.tsdf, target.weight, target.color
    old_tsdf, old_weight, old_color = source.tsdf.ravel(), source.weight.ravel(), source.color.ravel()
    for block in prange(label_source.shape[0]):
        found, nearby = np.empty(8, np.int32), np.empty(27, np.int32)
        portions = np.empty(8, np.float64)
        ids, votes = np.empty(8, np.int32), np.empty(8, np.float32)
        label_source[block] = -1
        exists, first = _nearby_blocks(source, R, t, coords[block], nearby)
        for n in range(BLOCK_VOXELS if exists else 0):
            x = np.float64(coords[block, 0] * BLOCK_SIDE + (n & 7))
            y = np.float64(coords[block, 1] * BLOCK_SIDE + ((n >> 3) & 7))
            z = np.float64(coords[block, 2] * BLOCK_SIDE + (n >> 6))
            px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
            py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
            pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
            if not _corner_voxels(nearby, first, np.int32(fx), np.int32(fy), np.int32(fz), found):
                continue
            wx, wy, wz = px - fx, py - fy, pz - fz
            observed = 0.0
            best = -1
            lowest, highest = np.int32(32767), np.int32(-32768)
            for c in range(8):
                portion = (wx if c & 1 else 1.0 - wx) * (wy if c & 2 else 1.0 - wy) * (wz if c & 4 else 1.0 - wz)
                voxel = found[c]
                if voxel < 0 or old_tsdf[voxel] == UNSEEN or portion <= 0.0:
                    portions[c] = 0.0
                    continue
                portions[c] = portion
                observed += portion
                lowest, highest = min(lowest, old_tsdf[voxel]), max(highest, old_tsdf[voxel])
                if best < 0 or portion > portions[best]:
                    best = c
            if observed < MIN_OBSERVED:
                continue
            if highest - lowest > most_jump:
                for c in range(8):
                    portions[c] = 1.0 if c == best else 0.0
                observed = 1.0
            distance = mass = colored = red = green = blue = 0.0
            for c in range(8):
                if portions[c] > 0.0:
                    distance += portions[c] * old_tsdf[found[c]]
                    mass += portions[c] * old_weight[found[c]]
                    packed = old_color[found[c]]
                    if packed & COLORED:
                        r, g, b = unpack_color(packed)
                        colored += portions[c]
                        red, green, blue = red + portions[c] * r, green + portions[c] * g, blue + portions[c] * b
            elected = best
            if len(instances.labeled) > 0 and abs(distance) <= observed * instances.near:
                elected = _elect(found, portions, old_tsdf, instances, ids, votes, best)
            label_source[block, n] = found[elected]
            tsdf[block, n] = np.int16(np.rint(distance / observed))
            weight[block, n] = np.uint16(max(1.0, np.rint(mass / observed)))
            if colored >= MIN_OBSERVED * observed:
                mean = pack_color(np.rint(red / colored), np.rint(green / colored), np.rint(blue / colored))
                color[block, n] = mean | (old_color[found[best]] & OUTDATED)
