"""Hidden submaps in compact form, as in map files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.data import Float64, Int32
from framework.mapping.labels.packed_evidence import PackedEvidence, pack_evidence
from framework.mapping.submaps.layer import Layer
from framework.mapping.submaps.resampling import resampled, resampled_voxels
from framework.mapping.voxels.packed_voxels import PackedVoxels, pack_voxels, unpack_voxels
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import find_solid_blocks


class HiddenSubmap(NamedTuple):
    """The observed voxels and the label evidence of B blocks.

    A motion only changes the transform. The voxels are resampled when they are needed, so that several motions blur
    them only once.
    """

    block_coords: Int32  # (B, 3)
    label_row: Int32  # (B,) evidence row of each block, -1 = none
    voxels: PackedVoxels
    evidence: PackedEvidence
    T_world_blocks: Float64 | None = None  # (4, 4) motion since the blocks were stored; None = none

    @classmethod
    def of(cls, layer: Layer) -> HiddenSubmap:
        """Return a copy of a layer in compact form."""
        grid, count = layer.voxels.grid, layer.voxels.block_count
        coords, rows = grid.block_coords[:count].copy(), grid.label_row[:count].copy()
        return cls(coords, rows, pack_voxels(layer.voxels), pack_evidence(layer.labels.in_use()))

    def layer(self, like: Layer) -> Layer:
        """Return the layer, with the parameters of another layer."""
        voxels = self._stored_voxels(like.voxels)
        layer = Layer(voxels, like.labels.like(voxels))
        voxels.grid.label_row[: len(self.label_row)] = self.label_row
        layer.labels.unpack(self.evidence)
        return layer if self.T_world_blocks is None else resampled(layer, self.T_world_blocks)

    def surface(self, like: VoxelGrid) -> VoxelGrid:
        """Return the voxels without labels, with the parameters of another grid."""
        voxels = self._stored_voxels(like)
        return voxels if self.T_world_blocks is None else resampled_voxels(voxels, self.T_world_blocks)[0]

    def _stored_voxels(self, like: VoxelGrid) -> VoxelGrid:
        """Return the voxels before the motion, without labels."""
        voxels = like.like(max(len(self.block_coords), 1))
        voxels.allocate(self.block_coords)
        unpack_voxels(self.voxels, voxels)
        find_solid_blocks(voxels.grid, voxels.block_count)
        return voxels

    def moved(self, T_new_old: Float64) -> HiddenSubmap:
        """Return the submap after a motion T_new_old (4, 4)."""
        return self._replace(
            T_world_blocks=T_new_old if self.T_world_blocks is None else T_new_old @ self.T_world_blocks
        )

    @property
    def byte_count(self) -> int:
        """Size, bytes."""
        arrays = (self.block_coords, self.label_row, *self.voxels, *self.evidence)
        return sum(array.nbytes for array in arrays)

    def instance_ids(self) -> list[int]:
        """Return the instances with evidence."""
        return [int(k) for k in np.unique(self.evidence.instance_ids)]
