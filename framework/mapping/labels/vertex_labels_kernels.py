"""Kernels for the color, instance and class of mesh vertices."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

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
REACH = 2.0  # maximum distance of voting voxels from the surface, voxels; farther ones may have labels of other objects
CHUNK = 1024  # number of vertices that share scratch arrays


@device
def corner_voxels(grid, vertex, blocks, voxels, weights):
    """Fill `blocks`, `voxels` and `weights`, (8,) each, for the eight voxels around a world-frame vertex (3,), m.

    `blocks` are block indices, -1 = not allocated, `voxels` are indices in the block, and `weights` are trilinear.
    Returns True if the block of any voxel has label evidence.
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
    """Set the weights (8,) of unobserved voxels and of voxels farther than REACH from the surface to 0."""
    near = np.float32(REACH) * grid.voxel_size
    for c in range(CORNERS):
        stored = grid.tsdf[blocks[c], voxels[c]] if blocks[c] >= 0 else np.int16(UNSEEN)
        if stored == UNSEEN or abs(stored) * grid.tsdf_unit > near:
            weights[c] = 0


@device
def majority(labels, weights):
    """Return the index of the voxel with the largest weight among the voxels with the majority label; -1 = no majority.

    The majority label is the positive entry of `labels` (8,) with more than half of the total of `weights` (8,).
    """
    total = np.float32(0.0)
    for c in range(CORNERS):
        total += weights[c]
    for c in range(CORNERS):
        votes = np.float32(0.0)
        largest = c
        for d in range(CORNERS):
            if labels[d] == labels[c]:
                votes += weights[d]
                if weights[d] > weights[largest]:
                    largest = d
        if labels[c] > 0 and votes > np.float32(0.5) * total:
            return largest
    return -1


@device
def _elect(grid, evidence, counts, blocks, voxels, weights, ids):
    """Return the instance and class of a vertex by majority vote of its eight voxels; 0 and -1 without a majority."""
    keep_near(grid, blocks, voxels, weights)
    for c in range(CORNERS):
        voxel = labeled_voxel(grid, evidence, blocks[c], voxels[c]) if weights[c] > 0 else np.int32(-1)
        ids[c] = best_counted_instance(evidence, voxel, counts) if voxel >= 0 else np.int32(0)
    elected = majority(ids, weights)
    if elected < 0:
        return np.int32(0), np.int32(-1)
    return ids[elected], best_class(evidence, labeled_voxel(grid, evidence, blocks[elected], voxels[elected]))


@device
def color_of(color, voxel, out):
    """Write the RGB color of a voxel, numbered as in an UnlabeledMesh, into `out` (3,), in [0, 255]."""
    red, green, blue = unpack_color(color[voxel // BLOCK_VOXELS, voxel % BLOCK_VOXELS])
    out[0], out[1], out[2] = red / 4, green / 4, blue / 4


@njit(cache=True, nogil=True, parallel=True)
def color_vertices(color, voxels, colors):
    """Fill colors (V, 3) with the RGB of voxels (V,), numbered as in an UnlabeledMesh."""
    for v in prange(len(voxels)):
        color_of(color, voxels[v], colors[v])


@njit(cache=True, nogil=True, parallel=True)
def label_vertices(grid, evidence, counts, surface, colors, instance_ids, class_ids):
    """Fill colors (V, 3), instance_ids (V,), 0 = none, and class_ids (V,), -1 = none, of an UnlabeledMesh's vertices.

    The color comes from the nearest voxel. The instance is the majority of the eight surrounding voxels, weighted
    trilinearly. Each voxel votes for its most likely instance among those with `counts[id]` True. The class comes from
    the voxel with the largest weight in the majority. Vertices without an instance have no class.
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
