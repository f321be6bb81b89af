"""Rigid motion of a layer.

The moved voxels are resampled on the voxel grid of the world. Distances, weights and colors are interpolated between
the observed voxels around each point. The label evidence of one of them is copied, see `resample`.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float64, Int32
from framework.geometry import inverse
from framework.mapping.labels.vertex_labels_kernels import REACH
from framework.mapping.submaps.layer import Layer
from framework.mapping.submaps.resampling_kernels import MAX_COVERED, VoxelInstances, covered_blocks, resample
from framework.mapping.voxels.allocation_kernels import unpack
from framework.mapping.voxels.meshing import MAX_JUMP
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, NO_KEY, find_solid_blocks

NO_INSTANCES = VoxelInstances(np.zeros(0, np.int32), np.zeros(0, np.int32), np.int32(0))


def resampled(layer: Layer, T_new_old: Float64) -> Layer:
    """Return a layer after a rigid motion T_new_old (4, 4) in the world frame.

    The order of its blocks depends on their coordinates alone.
    """
    grid, count = layer.voxels.grid, layer.voxels.block_count
    labeled = layer.labels.voxels_of(np.arange(count, dtype=np.int32)).ravel()
    near = np.int32(REACH * float(grid.voxel_size) / float(grid.tsdf_unit))
    instances = VoxelInstances(labeled, layer.labels.best_instances(), near)
    voxels, source = resampled_voxels(layer.voxels, T_new_old, instances)
    labels = layer.labels.like(voxels)
    labels.gather(layer.labels, np.where(source >= 0, labeled[source], np.int32(-1)))
    return Layer(voxels, labels)


def resampled_voxels(
    voxels: VoxelGrid, T_new_old: Float64, instances: VoxelInstances = NO_INSTANCES
) -> tuple[VoxelGrid, Int32]:
    """Return voxels without labels after a motion, and the old voxel (B, 512) of each voxel's labels, -1 = none.

    The number of an old voxel is 512 times its block plus its position in the block. See `resampled`.
    """
    grid, count = voxels.grid, voxels.block_count
    voxel_size = float(grid.voxel_size)
    keys = np.empty((count, MAX_COVERED), np.int64)
    covered_blocks(grid.block_coords[:count], *_in_voxels(T_new_old, voxel_size), keys)
    covered = np.unique(keys[keys != NO_KEY])
    coords = np.empty((len(covered), 3), np.int32)
    unpack(covered, coords)
    candidates = voxels.like(max(len(covered), 1))
    candidates.allocate(coords)
    source = np.empty((len(covered), BLOCK_VOXELS), np.int32)
    most_jump = np.int32(MAX_JUMP * voxel_size / float(grid.tsdf_unit))
    resample(grid, *_in_voxels(inverse(T_new_old), voxel_size), candidates.grid, most_jump, instances, source)
    blocks = np.flatnonzero((source >= 0).any(axis=1)).astype(np.int32)
    moved = candidates.part(blocks)
    find_solid_blocks(moved.grid, len(blocks))
    return moved, source[blocks]


def _in_voxels(T: Float64, voxel_size: float) -> tuple[Float64, Float64]:
    """Return the rotation (3, 3) and the translation (3,), in voxels, of a motion (4, 4)."""
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3] / voxel_size)
