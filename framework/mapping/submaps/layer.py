"""Layers: voxels with label evidence."""

from __future__ import annotations

from typing import NamedTuple

from framework.data import Int32
from framework.mapping.labels.evidence_rows import EvidenceRows
from framework.mapping.voxels.voxel_grid import VoxelGrid


class Layer(NamedTuple):
    """Voxels and their label evidence."""

    voxels: VoxelGrid
    labels: EvidenceRows

    def like(self, max_blocks: int) -> Layer:
        """Return an empty layer with the same parameters."""
        voxels = self.voxels.like(max_blocks)
        return Layer(voxels, self.labels.like(voxels))

    def part(self, blocks: Int32) -> Layer:
        """Return a copy of the blocks (N,)."""
        voxels = self.voxels.part(blocks)
        labels = self.labels.like(voxels)
        labels.gather(self.labels, self.labels.voxels_of(blocks))
        return Layer(voxels, labels)

    def keep(self, blocks: Int32) -> None:
        """Remove all other blocks, and renumber the blocks (N,), which are ascending."""
        self.labels.keep(blocks)
        self.voxels.keep(blocks)
