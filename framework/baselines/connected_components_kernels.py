"""Kernels of connected_components.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.baselines.class_evidence_kernels import best_class
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.vertex_labels_kernels import CHUNK, CORNERS, color_of, corner_voxels, keep_near, majority
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, device
from framework.refinement.segmentation.union_find import root, unite


@device
def _elect(grid, evidence, log_missed, blocks, numbers, shares, labels):
    """The class that has more than half of the votes of the voxels around a vertex, -1 if none has."""
    keep_near(grid, blocks, numbers, shares)
    for c in range(CORNERS):
        labels[c] = 1 + best_class(grid, evidence, log_missed, blocks[c], numbers[c]) if shares[c] > 0 else 0
    elected = majority(labels, shares)
    return labels[elected] - 1 if elected >= 0 else np.int32(-1)


@njit(cache=True, nogil=True, parallel=True)
def label_components(grid, evidence, log_missed, vertices, voxels, colors, class_ids):
    for chunk in prange(-(-len(voxels) // CHUNK)):
        blocks, numbers = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        labels, shares = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(voxels))):
            color_of(grid.color, voxels[v], colors[v])
            class_ids[v] = -1
            if corner_voxels(grid, vertices[v], blocks, numbers, shares):
                class_ids[v] = _elect(grid, evidence, log_missed, blocks, numbers, shares, labels)


@njit(cache=True, nogil=True)
def connect_vertices(triangles, class_ids, pieces):
    """Fills pieces (V,) with the first vertex of each vertex's piece."""
    for v in range(len(pieces)):
        pieces[v] = v
    for t in range(len(triangles)):
        for side in range(3):
            a, b = triangles[t, side], triangles[t, (side + 1) % 3]
            if class_ids[a] == class_ids[b]:
                unite(pieces, a, b)
    for v in range(len(pieces)):
        pieces[v] = root(pieces, v)


@njit(cache=True, nogil=True)
def collect(grid, evidence, log_missed, voxels, instance_ids, sums, masked, first_frame, last_frame):
    """Adds up what the voxel nearest to each vertex says; rows of sums (K + 1, C) are those of components."""
    classes = sums.shape[1]
    rest_sums = np.zeros(len(sums))
    for v in range(len(voxels)):
        k = instance_ids[v]
        block, n = voxels[v] // BLOCK_VOXELS, voxels[v] % BLOCK_VOXELS
        row = grid.label_row[block]
        if k == 0 or row < 0:
            continue
        labels, ratios = evidence.class_ids[row, n], evidence.log_ratio[row, n]
        absent = log_missed * np.float64(evidence.unmasked[block, n])
        named = 0
        while named < len(labels) and labels[named] != NO_CLASS:
            named += 1
        rest = evidence.rest[row, n] + absent
        most = max(0.0, rest)  # of the logarithms, the background's 0 among them
        if named > 0:
            most = max(most, ratios[0] + absent)
        p_rest = np.exp(rest - most)
        total = np.exp(-most) + (classes - named) * p_rest
        for s in range(named):
            total += np.exp(ratios[s] + absent - most)
        rest_sums[k] += p_rest / total
        for s in range(named):
            sums[k, labels[s]] += (np.exp(ratios[s] + absent - most) - p_rest) / total
        masked[k] = max(masked[k], evidence.masked[row, n])
        if evidence.masked[row, n] > 0:
            first = evidence.first_frame[row, n]
            first_frame[k] = first if first_frame[k] < 0 else min(first_frame[k], first)
            last_frame[k] = max(last_frame[k], evidence.last_frame[row, n])
    for k in range(len(sums)):
        for c in range(classes):
            sums[k, c] = max(sums[k, c] + rest_sums[k], 0.0)  # a difference of sums may be a hair below 0
