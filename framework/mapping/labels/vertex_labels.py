"""Colors and labels of mesh vertices, updated block by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Bool, Int32, UInt8
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.labels.vertex_labels_kernels import carry_over, label_vertices, mark_around
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.voxel_grid import Grid


class Labels(NamedTuple):
    """The colors and labels of V vertices."""

    colors: UInt8  # (V, 3) RGB
    instance_ids: Int32  # (V,), 0 = none
    class_ids: Int32  # (V,), -1 = none


class VertexLabels:
    """The labels of the vertices of a surface. An update computes them only near changed voxels."""

    def __init__(self) -> None:
        self._labels = Labels(np.empty((0, 3), np.uint8), *np.empty((2, 0), np.int32))
        self._starts = np.zeros(1, np.int32)  # (B + 1,) first vertex of each block, and number of vertices
        self.counts: Bool = np.zeros(0, np.bool_)  # ids that could be assigned in the last update

    def __reduce__(self) -> tuple[type[VertexLabels], tuple[()]]:
        return VertexLabels, ()

    def shows(self, instance_id: int) -> bool:
        """Return True if the instance could be assigned in the last update."""
        return instance_id < len(self.counts) and bool(self.counts[instance_id])

    def changed_ids(self, counts: Bool) -> set[int]:
        """Return the instance ids that can be assigned by either `counts` or the last update, but not by both."""
        last, now = np.zeros((2, max(len(counts), len(self.counts))), np.bool_)
        last[: len(self.counts)], now[: len(counts)] = self.counts, counts
        return set(np.flatnonzero(last != now).tolist())

    def update(
        self, grid: Grid, evidence: Evidence, counts: Bool, surface: UnlabeledMesh, starts: Int32, changed: Bool
    ) -> Labels:
        """Return the labels of the current surface.

        Args:
            grid: The voxel grid.
            evidence: The label evidence.
            counts: A Boolean array, True for the instance ids that can be assigned.
            surface: The surface.
            starts: The first vertex (B + 1,) of each block, and the number of vertices.
            changed: A Boolean array (B,), True for blocks with changed voxels or labels since the last update.
        """
        count = len(surface.vertices)
        labels = Labels(np.empty((count, 3), np.uint8), *np.empty((2, count), np.int32))
        outdated = np.zeros(len(changed), np.bool_)
        outdated[len(self._starts) - 1 :] = True  # new blocks
        mark_around(grid, np.flatnonzero(changed).astype(np.int32), outdated)
        carry_over(outdated, starts, self._starts, self._labels, labels)
        vertices = np.flatnonzero(np.repeat(outdated, np.diff(starts)))
        near = UnlabeledMesh(surface.vertices[vertices], surface.triangles[:0], surface.voxels[vertices])
        found = Labels(np.empty((len(vertices), 3), np.uint8), *np.empty((2, len(vertices)), np.int32))
        label_vertices(grid, evidence, counts, near, *found)
        labels.colors[vertices] = found.colors
        labels.instance_ids[vertices] = found.instance_ids
        labels.class_ids[vertices] = found.class_ids
        self._labels, self._starts, self.counts = labels, starts, counts
        return labels
