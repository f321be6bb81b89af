"""Kernels of semantic_map.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.baselines.class_evidence_kernels import best_class
from framework.compilation.kernel_cache import njit
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.vertex_labels_kernels import CHUNK, CORNERS, color_of, corner_voxels, keep_near, majority
from framework.mapping.voxels.raycasting_kernels import voxel_seen
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, NO_LOOK_UP, device
from framework.refinement.segmentation.union_find import root, unite


@njit(cache=True, nogil=True, parallel=True)
def label_view(grid, evidence, log_missed, view, depth, class_ids):
    """Fill the class of each pixel from the voxel nearest to the surface.

    Args:
        grid: The voxel grid.
        evidence: The class evidence.
        log_missed: The log ratio of every class to the background for a frame outside all masks.
        view: The camera with the pose T_world_camera.
        depth: The depth (H, W) of the surface, m.
        class_ids: The output (H, W), -1 = none.
    """
    for v in prange(depth.shape[0]):
        key, region = NO_LOOK_UP
        for u in range(depth.shape[1]):
            class_ids[v, u] = -1
            if depth[v, u] > 0:
                block, n, key, region = voxel_seen(grid, view, u, v, depth[v, u], key, region)
                if block >= 0:
                    class_ids[v, u] = best_class(grid, evidence, log_missed, block, n)


@device
def _elect(grid, evidence, log_missed, blocks, voxels, weights, labels):
    """Return the majority class of the eight voxels around a vertex, -1 = background or no majority."""
    keep_near(grid, blocks, voxels, weights)
    for c in range(CORNERS):
        labels[c] = 1 + best_class(grid, evidence, log_missed, blocks[c], voxels[c]) if weights[c] > 0 else 0
    elected = majority(labels, weights)
    return labels[elected] - 1 if elected >= 0 else np.int32(-1)


@njit(cache=True, nogil=True, parallel=True)
def label_classes(grid, evidence, log_missed, surface, colors, class_ids):
    """Fill the color (V, 3) and the class (V,) of each vertex of a mesh, -1 = background."""
    vertices = surface.vertices
    for chunk in prange(-(-len(vertices) // CHUNK)):
        blocks, voxels = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        labels, weights = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(vertices))):
            color_of(grid.color, surface.voxels[v], colors[v])
            class_ids[v] = -1
            if corner_voxels(grid, vertices[v], blocks, voxels, weights):
                class_ids[v] = _elect(grid, evidence, log_missed, blocks, voxels, weights, labels)


@device
def _log_ratio(grid, evidence, log_missed, block, n, label):
    """Return the log ratio of a class to the background in voxel n of a block."""
    if label < 0:
        return np.float32(0)
    absent = log_missed * np.float32(evidence.unmasked[block, n])
    row = grid.label_row[block]
    if row < 0:
        return absent
    for s in range(evidence.class_ids.shape[2]):
        if evidence.class_ids[row, n, s] == label + 1:
            return evidence.log_ratio[row, n, s] + absent
    return evidence.rest[row, n] + absent


@njit(cache=True, nogil=True)
def smooth_classes(grid, evidence, log_missed, voxels, starts, neighbors, smoothness, class_ids):
    """Set the class of each vertex to the class with the highest score, and return the number of changes.

    The score is the log ratio of the class to the background, plus `smoothness` for each neighbor of the same class.
    Ties go to the current class.

    Args:
        grid: The voxel grid.
        evidence: The class evidence.
        log_missed: The log ratio of every class to the background for a frame outside all masks.
        voxels: The voxel (V,) nearest to each vertex, as block * 512 + index in the block.
        starts: The start (V + 1,) of the neighbors of each vertex in `neighbors`.
        neighbors: The neighbors of the vertices.
        smoothness: The log-odds for each neighbor of the same class.
        class_ids: The class (V,) of each vertex, -1 = background, modified in place.
    """
    changes = 0
    for v in range(len(class_ids)):
        block, n = voxels[v] // BLOCK_VOXELS, voxels[v] % BLOCK_VOXELS
        around = neighbors[starts[v] : starts[v + 1]]
        best, largest = class_ids[v], np.float32(-np.inf)
        for candidate in range(-3, len(around)):  # current class, background, best class of the voxel, neighbors
            label = class_ids[v]
            if candidate == -2:
                label = np.int32(-1)
            elif candidate == -1:
                label = best_class(grid, evidence, log_missed, block, n)
            elif candidate >= 0:
                label = class_ids[around[candidate]]
            value = _log_ratio(grid, evidence, log_missed, block, n, label)
            for w in around:
                if class_ids[w] == label:
                    value += smoothness
            if value > largest:
                best, largest = label, value
        changes += best != class_ids[v]
        class_ids[v] = best
    return changes


@njit(cache=True, nogil=True)
def connect_vertices(triangles, class_ids, components):
    """Set the component (V,) of each vertex to its first vertex.

    Edges of triangles (F, 3) connect vertices of the same class.
    """
    for v in range(len(components)):
        components[v] = v
    for t in range(len(triangles)):
        for side in range(3):
            a, b = triangles[t, side], triangles[t, (side + 1) % 3]
            if class_ids[a] == class_ids[b]:
                unite(components, a, b)
    for v in range(len(components)):
        components[v] = root(components, v)


@njit(cache=True, nogil=True)
def sum_components(grid, evidence, log_missed, voxels, instance_ids, found):
    """Add the evidence of the voxel nearest to each vertex to the statistics of its component.

    Args:
        grid: The voxel grid.
        evidence: The class evidence.
        log_missed: The log ratio of every class to the background for a frame outside all masks.
        voxels: The voxel (V,) nearest to each vertex, as block * 512 + index in the block.
        instance_ids: The component (V,) of each vertex, 0 = none.
        found: The statistics, initially empty, modified in place.
    """
    sums, masked, first_frame, last_frame = found.probability_sums, found.masked, found.first_frame, found.last_frame
    classes = sums.shape[1]
    unnamed_sums = np.zeros(len(sums))
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
        unnamed = evidence.rest[row, n] + absent
        largest = max(0.0, unnamed)  # largest log ratio; the background has 0
        if named > 0:
            largest = max(largest, ratios[0] + absent)
        p_unnamed = np.exp(unnamed - largest)
        total = np.exp(-largest) + (classes - named) * p_unnamed
        for s in range(named):
            total += np.exp(ratios[s] + absent - largest)
        unnamed_sums[k] += p_unnamed / total
        for s in range(named):
            sums[k, labels[s] - 1] += (np.exp(ratios[s] + absent - largest) - p_unnamed) / total
        masked[k] = max(masked[k], evidence.masked[row, n])
        if evidence.masked[row, n] > 0:
            first = evidence.first_frame[row, n]
            first_frame[k] = first if first_frame[k] < 0 else min(first_frame[k], first)
            last_frame[k] = max(last_frame[k], evidence.last_frame[row, n])
    for k in range(len(sums)):
        for c in range(classes):
            sums[k, c] = max(sums[k, c] + unnamed_sums[k], 0.0)  # rounding may make the difference slightly negative
