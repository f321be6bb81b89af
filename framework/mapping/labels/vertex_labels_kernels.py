"""Kernels for the colors and labels of mesh vertices."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.labels.label_evidence_kernels import best_class, best_counted_instance, labeled_voxel
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_VOXELS,
    NO_LOOK_UP,
    UNSEEN,
    device,
    find_block,
    unpack_color,
)
from framework.mapping.voxels.voxel_walk import voxel_number

CORNERS = 8  # number of voxels around a vertex
REACH = 2.0  # maximum distance of voting voxels from the surface, voxels; farther voxels may belong to other objects
CHUNK = 1024  # number of vertices that share scratch arrays


@device
def corner_voxels(grid, vertex, blocks, voxels, weights):
    """Find the eight voxels around a vertex (3,), m, and return True if any of their blocks has label evidence.

    Args:
        grid: The voxel grid.
        vertex: The vertex (3,) in the world frame, m.
        blocks: The output (8,), the block of each voxel, -1 = not allocated.
        voxels: The output (8,), the index of each voxel in its block.
        weights: The output (8,), the trilinear weights.
    """
    scale = np.float32(1.0) / grid.voxel_size
    x, y, z = vertex[0] * scale, vertex[1] * scale, vertex[2] * scale
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    x, y, z = x - i, y - j, z - k
    key, region = NO_LOOK_UP
    labeled = False
    for c in range(CORNERS):
        dx, dy, dz = c & 1, (c >> 1) & 1, c >> 2
        block, key, region = find_block(grid, (i + dx) >> 3, (j + dy) >> 3, (k + dz) >> 3, key, region)
        blocks[c] = block
        voxels[c] = voxel_number(i + dx, j + dy, k + dz)
        weights[c] = (x if dx else 1 - x) * (y if dy else 1 - y) * (z if dz else 1 - z)
        labeled = labeled or (block >= 0 and grid.label_row[block] >= 0)
    return labeled


@device
def keep_near(grid, blocks, voxels, weights):
    """Set the weights (8,) of voxels that are unobserved or far from the surface to 0."""
    near = np.float32(REACH) * grid.voxel_size
    for c in range(CORNERS):
        stored = grid.tsdf[blocks[c], voxels[c]] if blocks[c] >= 0 else np.int16(UNSEEN)
        if stored == UNSEEN or abs(stored) * grid.tsdf_unit > near:
            weights[c] = 0


@device
def most_common(labels, weights):
    """Return the index of the largest weight (8,) among the voxels with the most common label, and the label's weight.

    If all weights are 0, the index is 0.
    """
    elected, most = 0, np.float32(0.0)
    for c in range(CORNERS):
        votes = np.float32(0.0)
        largest = c
        for d in range(CORNERS):
            if labels[d] == labels[c]:
                votes += weights[d]
                if weights[d] > weights[largest]:
                    largest = d
        if votes > most:
            elected, most = largest, votes
    return elected, most


@device
def majority(labels, weights):
    """Return the index of the largest weight (8,) among the voxels with the majority label, -1 = no majority.

    The majority label is positive and has more than half of the total weight.
    """
    elected, votes = most_common(labels, weights)
    total = np.float32(0.0)
    for c in range(CORNERS):
        total += weights[c]
    return elected if labels[elected] > 0 and votes > np.float32(0.5) * total else -1


@device
def _elect(grid, evidence, counts, blocks, voxels, weights, ids):
    """Return the instance and the class of a vertex by majority vote of its eight voxels."""
    keep_near(grid, blocks, voxels, weights)
    for c in range(CORNERS):
        voxel = labeled_voxel(grid, evidence, blocks[c], voxels[c]) if weights[c] > 0 else np.int32(-1)
        ids[c] = best_counted_instance(evidence, voxel, counts) if voxel >= 0 else np.int32(0)
    elected = majority(ids, weights)
    if elected < 0:  # no majority
        return np.int32(0), np.int32(-1)
    return ids[elected], best_class(evidence, labeled_voxel(grid, evidence, blocks[elected], voxels[elected]))


@device
def color_of(color, voxel, out):
    """Write the color of a voxel to `out` (3,), RGB.

    The voxel is given as block * 512 + index in the block.
    """
    red, green, blue = unpack_color(color[voxel // BLOCK_VOXELS, voxel % BLOCK_VOXELS])
    out[0], out[1], out[2] = red / 4, green / 4, blue / 4


@njit(cache=True, nogil=True, parallel=True)
def color_vertices(color, voxels, colors):
    """Fill the colors (V, 3), RGB, of voxels (V,).

    A voxel is given as block * 512 + index in the block.
    """
    for v in prange(len(voxels)):
        color_of(color, voxels[v], colors[v])


@njit(cache=True, nogil=True, parallel=True)
def label_vertices(grid, evidence, counts, surface, colors, instance_ids, class_ids):
    """Fill the color, instance and class of each vertex of a mesh.

    The color comes from the nearest voxel. The instance is the majority of the eight surrounding voxels, weighted
    trilinearly. The class comes from the voxel with the largest weight in the majority.

    Args:
        grid: The voxel grid.
        evidence: The label evidence.
        counts: A Boolean array, True for the instance ids that can be assigned.
        surface: The mesh without labels.
        colors: The output (V, 3), RGB.
        instance_ids: The output (V,), 0 = none.
        class_ids: The output (V,), -1 = none.
    """
    vertices = surface.vertices
    for chunk in prange(-(-len(vertices) // CHUNK)):
        blocks, voxels = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        ids, weights = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(vertices))):
            color_of(grid.color, surface.voxels[v], colors[v])
            instance, label = np.int32(0), np.int32(-1)
            if corner_voxels(grid, vertices[v], blocks, voxels, weights):
                instance, label = _elect(grid, evidence, counts, blocks, voxels, weights, ids)
            instance_ids[v] = instance
            class_ids[v] = label


@njit(cache=True, nogil=True, parallel=True)
def mark_around(grid, blocks, marked):
    """Set `marked` (B,) to True for the given blocks (A,) and all blocks next to them."""
    for a in prange(len(blocks)):
        key, region = NO_LOOK_UP
        bx, by, bz = grid.block_coords[blocks[a], 0], grid.block_coords[blocks[a], 1], grid.block_coords[blocks[a], 2]
        for o in range(27):
            x, y, z = bx + o % 3 - 1, by + o // 3 % 3 - 1, bz + o // 9 - 1
            block, key, region = find_block(grid, x, y, z, key, region)
            if block >= 0:
                marked[block] = True


@njit(cache=True, nogil=True, parallel=True)
def carry_over(outdated, starts, old_starts, old, new):
    """Copy the labels of all blocks that are not outdated from an earlier mesh.

    Args:
        outdated: A Boolean array (B,), True for blocks whose labels are not copied.
        starts: The first vertex (B + 1,) of each block, and the number of vertices.
        old_starts: The same numbers in the earlier mesh.
        old: The labels of the earlier mesh.
        new: The output.
    """
    colors, instance_ids, class_ids = new.colors, new.instance_ids, new.class_ids
    for block in prange(len(outdated)):
        if not outdated[block]:
            source = old_starts[block]
            for v in range(starts[block], starts[block + 1]):
                for c in range(3):
                    colors[v, c] = old.colors[source, c]
                instance_ids[v] = old.instance_ids[source]
                class_ids[v] = old.class_ids[source]
                source += 1
