"""Instances without instance labels: the connected pieces of a mesh whose vertices are of one class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from framework.baselines.class_evidence import ClassEvidence
from framework.baselines.connected_components_kernels import collect, connect_vertices, label_components
from framework.data import Float64, Int32, UInt8
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid import Grid


def vertex_classes(
    grid: Grid, evidence: ClassEvidence, log_missed: np.float32, surface: UnlabeledMesh
) -> tuple[UInt8, Int32]:
    """(colors (V, 3), class ids (V,)) of the surface's vertices, class -1 = background.

    The class is elected as the instance is in `vertex_labels`, so that a difference between the two is not one of
    drawing.
    """
    colors = np.empty((len(surface.voxels), 3), np.uint8)
    class_ids = np.empty(len(surface.voxels), np.int32)
    label_components(grid, evidence, log_missed, surface.vertices, surface.voxels, colors, class_ids)
    return colors, class_ids


def connected_components(triangles: Int32, class_ids: Int32, least: int) -> Int32:
    """(V,) ids, from 1 in the order of first vertices, of the pieces of one class, those of at least `least` vertices.

    0 = a smaller piece or no class. Two vertices of one class are of one piece where a way along edges of the triangles
    (F, 3) joins them that does not leave the class.
    """
    pieces = np.empty(len(class_ids), np.int32)
    connect_vertices(triangles, class_ids, pieces)
    counts = np.bincount(pieces[class_ids >= 0], minlength=len(pieces)) >= least
    return np.where((class_ids >= 0) & counts[pieces], np.cumsum(counts)[pieces], 0).astype(np.int32)


class ComponentStatistics(NamedTuple):
    """What the voxels of each of K components, by id, say together; entry 0 is of what is in no component."""

    vertices: npt.NDArray[np.int64]  # (K + 1,) how many
    probability_sums: Float64  # (K + 1, C) of each class, over the vertices; what a row lacks is the background's
    masked: Int32  # (K + 1,) the most frames in which one of its voxels was under a mask
    first_frame: Int32  # (K + 1,) the first and the last frame in which any of them was, -1 = none
    last_frame: Int32  # (K + 1,)


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
    collect(grid, evidence, log_missed, surface.voxels, instance_ids, *found[1:])
    return found
