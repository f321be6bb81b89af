"""Instances without instance labels: the connected pieces of a mesh whose vertices are of one class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.baselines.class_evidence import ClassEvidence, best_class
from framework.data import Float64, Int32, UInt8
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.vertex_labels import CHUNK, CORNERS, color_of, corner_voxels, keep_near, majority
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid import BLOCK_VOXELS, Grid, device
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
def _label(grid, evidence, log_missed, vertices, voxels, colors, class_ids):
    for chunk in prange(-(-len(voxels) // CHUNK)):
        blocks, numbers = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        labels, shares = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.float32)
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(voxels))):
            color_of(grid.color, voxels[v], colors[v])
            class_ids[v] = -1
            if corner_voxels(grid, vertices[v], blocks, numbers, shares):
                class_ids[v] = _elect(grid, evidence, log_missed, blocks, numbers, shares, labels)


def vertex_classes(
    grid: Grid, evidence: ClassEvidence, log_missed: np.float32, surface: UnlabeledMesh
) -> tuple[UInt8, Int32]:
    """(colors (V, 3), class ids (V,)) of the surface's vertices, class -1 = background.

    The class is elected as the instance is in `vertex_labels`, so that a difference between the two is not one of
    drawing.
    """
    colors = np.empty((len(surface.voxels), 3), np.uint8)
    class_ids = np.empty(len(surface.voxels), np.int32)
    _label(grid, evidence, log_missed, surface.vertices, surface.voxels, colors, class_ids)
    return colors, class_ids


@njit(cache=True, nogil=True)
def _connect(triangles, class_ids, pieces):
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


def connected_components(triangles: Int32, class_ids: Int32, least: int) -> Int32:
    """(V,) ids, from 1 in the order of first vertices, of the pieces of one class, those of at least `least` vertices.

    0 = a smaller piece or no class. Two vertices of one class are of one piece where a way along edges of the triangles
    (F, 3) joins them that does not leave the class.
    """
    pieces = np.empty(len(class_ids), np.int32)
    _connect(triangles, class_ids, pieces)
    counts = np.bincount(pieces[class_ids >= 0], minlength=len(pieces)) >= least
    return np.where((class_ids >= 0) & counts[pieces], np.cumsum(counts)[pieces], 0).astype(np.int32)


class ComponentStatistics(NamedTuple):
    """What the voxels of each of K components, by id, say together; entry 0 is of what is in no component."""

    vertices: npt.NDArray[np.int64]  # (K + 1,) how many
    probability_sums: Float64  # (K + 1, C) of each class, over the vertices; what a row lacks is the background's
    masked: Int32  # (K + 1,) the most frames in which one of its voxels was under a mask
    first_frame: Int32  # (K + 1,) the first and the last frame in which any of them was, -1 = none
    last_frame: Int32  # (K + 1,)


@njit(cache=True, nogil=True)
def _collect(grid, evidence, log_missed, voxels, instance_ids, sums, masked, first_frame, last_frame):
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


def component_statistics(
    grid: Grid,
    evidence: ClassEvidence,
    log_missed: np.float32,
    surface: UnlabeledMesh,
    instance_ids: Int32,
    classes: int,
) -> ComponentStatistics:
    """What the map says of each of the components that `instance_ids` (V,) name."""
    vertices = np.bincount(instance_ids, minlength=1)
    found = ComponentStatistics(
        vertices,
        np.zeros((len(vertices), classes)),
        np.zeros(len(vertices), np.int32),
        np.full(len(vertices), -1, np.int32),
        np.full(len(vertices), -1, np.int32),
    )
    _collect(grid, evidence, log_missed, surface.voxels, instance_ids, *found[1:])
    return found
