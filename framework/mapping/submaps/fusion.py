"""Fusion of layers.

Distances are averaged by weight. The evidence of both layers is added, because log-likelihoods are sums. Only
resampling separates the result from joint integration.
"""

from __future__ import annotations

import numpy as np

from framework.data import Int32
from framework.mapping.instances.association import match_one_to_one
from framework.mapping.instances.overlaps import OverlapRule, Overlaps
from framework.mapping.submaps.fusion_kernels import count_shared, fuse_voxels
from framework.mapping.submaps.layer import Layer
from framework.mapping.voxels.voxel_grid import WEIGHT_ONE, VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import find_solid_blocks


def fuse(layer: Layer, other: Layer, max_weight: float) -> Int32:
    """Add another layer to a layer, and return the block (B,) of each of its blocks.

    Args:
        layer: The layer, changed in place.
        other: The other layer.
        max_weight: The maximum weight of a voxel, in observations.

    Raises:
        MapFullError: If the layer needs too many blocks. It is then unchanged, except for new empty blocks.
    """
    blocks = fuse_grids(layer.voxels, other.voxels, max_weight)
    layer.labels.add(blocks, other.labels)
    return blocks


def fuse_grids(voxels: VoxelGrid, other: VoxelGrid, max_weight: float) -> Int32:
    """Add the voxels of another grid, without labels. See `fuse`."""
    blocks = voxels.allocate(other.grid.block_coords[: other.block_count])
    fuse_voxels(voxels.grid, blocks, other.grid, WEIGHT_ONE * max_weight)
    find_solid_blocks(voxels.grid, voxels.block_count)
    return blocks


def shared_instances(layer: Layer, other: Layer, min_overlap: float, min_voxels: int) -> list[tuple[int, int]]:
    """Return the pairs of instances of two layers that are the same object, before the layers are fused.

    The rule is the rule of the data association: matching is one to one in order of decreasing IoU, and the overlap is
    relative to the smaller instance. Both are counted in the voxels that both layers observe.

    Args:
        layer: The first layer.
        other: The second layer.
        min_overlap: The minimum overlap.
        min_voxels: The minimum denominator of the overlap.
    """
    blocks = layer.voxels.find(other.voxels.grid.block_coords[: other.voxels.block_count])
    shared = np.flatnonzero(blocks >= 0)
    ids, other_ids = layer.labels.best_ids(), other.labels.best_ids()
    counts = np.zeros((len(ids) + 1, len(other_ids) + 1), np.int32)
    own_index, other_index = _index(ids), _index(other_ids)
    grid, theirs = layer.voxels.grid, other.voxels.grid
    count_shared(
        grid.tsdf, blocks[shared], layer.labels.evidence, grid.label_row, own_index,
        theirs.tsdf[shared], other.labels.evidence, theirs.label_row[shared], other_index, counts,
    )  # fmt: skip
    votes = counts[1:, 1:]
    overlaps = Overlaps(other_ids, counts[:, 1:].sum(axis=0), counts[1:].sum(axis=1), votes, votes, 1)
    allowed = overlaps.by(OverlapRule.SMALLER, min_voxels) > min_overlap
    match = match_one_to_one(allowed, overlaps.over_union(min_voxels))
    return [(int(ids[row]), int(other_ids[column])) for row, column in enumerate(match) if column >= 0]


def _index(ids: Int32) -> Int32:
    """Return the position of each id in ascending `ids`, counted from 1, 0 for all other ids."""
    index = np.zeros(int(ids.max(initial=0)) + 1, np.int32)
    index[ids] = np.arange(1, len(ids) + 1, dtype=np.int32)
    return index
