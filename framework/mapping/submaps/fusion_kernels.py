"""Kernels of fusion.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_VOXELS,
    COLORED,
    OUTDATED,
    UNSEEN,
    pack_color,
    unpack_color,
)


@njit(cache=True, nogil=True, parallel=True)
def fuse_voxels(target, blocks, source, max_weight):
    """Add voxels to other voxels: averages by weight, and sums of weights.

    Args:
        target: The voxel grid to change.
        blocks: The block (B,) in the target of each source block. They are distinct.
        source: The voxel grid to add.
        max_weight: The maximum weight.
    """
    tsdf, weight, color = target.tsdf, target.weight, target.color
    for b in prange(blocks.shape[0]):
        block = blocks[b]
        for n in range(BLOCK_VOXELS):
            new = source.tsdf[b, n]
            if new == UNSEEN:
                continue
            old = tsdf[block, n]
            if old == UNSEEN:
                tsdf[block, n], weight[block, n], color[block, n] = new, source.weight[b, n], source.color[b, n]
                continue
            w_old, w_new = np.float64(weight[block, n]), np.float64(source.weight[b, n])
            portion = w_new / max(w_old + w_new, 1.0)
            tsdf[block, n] = np.int16(np.rint(old + portion * (np.float64(new) - np.float64(old))))
            weight[block, n] = np.uint16(min(w_old + w_new, max_weight))
            own, other = color[block, n], source.color[b, n]
            is_current = (own & (COLORED | OUTDATED)) == COLORED
            if not other & COLORED:
                continue
            if not is_current:
                color[block, n] = other
            elif not other & OUTDATED:
                r, g, b_ = unpack_color(own)
                r2, g2, b2 = unpack_color(other)
                color[block, n] = pack_color(
                    np.rint(r + portion * (r2 - r)), np.rint(g + portion * (g2 - g)), np.rint(b_ + portion * (b2 - b_))
                )


@njit(cache=True, nogil=True)
def count_shared(tsdf, blocks, evidence, label_row, own_index, other_tsdf, other, other_row, other_index, counts):
    """Count the voxels that two layers observe, by the most likely instance in each layer.

    Voxels without labels in both layers are ignored.

    Args:
        tsdf: The stored distances of the first layer.
        blocks: The block (B,) in the first layer of each block of the second layer.
        evidence: The label evidence of the first layer.
        label_row: The row of every block of the first layer, -1 = none.
        own_index: The row of `counts` of each instance id, 0 = none.
        other_tsdf: The stored distances of the second layer.
        other: The label evidence of the second layer.
        other_row: The row of every block of the second layer, -1 = none.
        other_index: The column of `counts` of each instance id, 0 = none.
        counts: The output (rows, columns).
    """
    for b in range(blocks.shape[0]):
        row, row_b = label_row[blocks[b]], other_row[b]
        if row < 0 and row_b < 0:
            continue
        for n in range(BLOCK_VOXELS):
            if tsdf[blocks[b], n] == UNSEEN or other_tsdf[b, n] == UNSEEN:
                continue
            voxel = evidence.labeled[row, n] if row >= 0 else -1
            voxel_b = other.labeled[row_b, n] if row_b >= 0 else -1
            if voxel < 0 and voxel_b < 0:
                continue
            own = evidence.instance_ids[voxel, 0] if voxel >= 0 and evidence.instance_value[voxel, 0] > 0 else 0
            theirs = other.instance_ids[voxel_b, 0] if voxel_b >= 0 and other.instance_value[voxel_b, 0] > 0 else 0
            counts[own_index[own], other_index[theirs]] += 1
