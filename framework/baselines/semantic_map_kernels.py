"""Kernels of semantic_map.py."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from framework.baselines.class_evidence_kernels import best_class
from framework.mapping.voxels.raycasting_kernels import voxel_seen


@njit(cache=True, nogil=True, parallel=True)
def label_view(grid, evidence, log_missed, view, depth, class_ids):
    """Fills class_ids (H, W) with the classes of the voxels nearest to the surface at `depth` (H, W) m."""
    for v in prange(depth.shape[0]):
        key = np.int64(-2)
        region = np.int32(-1)
        for u in range(depth.shape[1]):
            class_ids[v, u] = -1
            if depth[v, u] > 0:
                block, n, key, region = voxel_seen(grid, view, u, v, depth[v, u], key, region)
                if block >= 0:
                    class_ids[v, u] = best_class(grid, evidence, log_missed, block, n)
