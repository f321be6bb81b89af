"""Color, instance and class of the vertices of the map's mesh."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Int32, UInt8
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.labels.vertex_labels_kernels import color_vertices, label_vertices
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid import Grid


def vertex_labels(grid: Grid, evidence: Evidence, counts: Bool, surface: UnlabeledMesh) -> tuple[UInt8, Int32, Int32]:
    """Return the colors (V, 3), instance ids (V,) and class ids (V,) of the surface's vertices.

    The color is that of the nearest voxel. The instance is the majority of the eight surrounding voxels, weighted
    trilinearly, each with its most likely instance that has counts[id]. Vertices without an instance have no class.
    """
    count = len(surface.voxels)
    colors = np.empty((count, 3), np.uint8)
    instance_ids, class_ids = np.empty((2, count), np.int32)
    label_vertices(grid, evidence, counts, surface, colors, instance_ids, class_ids)
    return colors, instance_ids, class_ids


def vertex_colors(grid: Grid, voxels: Int32) -> UInt8:
    """Return the RGB (V, 3) of voxels, numbered as in an UnlabeledMesh."""
    colors = np.empty((len(voxels), 3), np.uint8)
    color_vertices(grid.color, voxels, colors)
    return colors
