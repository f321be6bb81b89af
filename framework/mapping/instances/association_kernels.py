"""Kernels of association.py and overlaps.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Int32
from framework.mapping.labels.label_evidence import Evidence
from framework.mapping.labels.label_evidence_kernels import best_instance, label_row
from framework.mapping.labels.pixel_lists_kernels import CHUNKS
from framework.mapping.voxels.integration_parameters import Pinhole
from framework.mapping.voxels.raycasting_kernels import voxel_seen
from framework.mapping.voxels.voxel_grid import Grid
from framework.mapping.voxels.voxel_grid_kernels import NO_LOOK_UP, device
from framework.mapping.voxels.voxel_walk import prefetch_element


@njit(cache=True, nogil=True, parallel=True)
def look_up_instances(
    grid: Grid, evidence: Evidence, depth: Float32, view: Pinhole, stride: int, instance_ids: Int32
) -> None:
    """Look up the most likely instance at the measured surface at every stride-th pixel of a frame.

    Args:
        grid: The voxel grid.
        evidence: The label evidence.
        depth: The depth image (H, W), m.
        view: The camera with the pose T_world_camera.
        stride: The distance between the pixels, px.
        instance_ids: The output (ceil(H / stride), ceil(W / stride)), 0 = none.
    """
    columns = instance_ids.shape[1]
    for row in prange(instance_ids.shape[0]):
        key, region = NO_LOOK_UP
        rows, voxels = np.empty(columns, np.int32), np.empty(columns, np.int32)
        for column in range(columns):
            rows[column] = -1
            z = depth[row * stride, column * stride]
            if z > np.float32(0.0):
                block, n, key, region = voxel_seen(grid, view, column * stride, row * stride, z, key, region)
                rows[column], voxels[column] = label_row(grid, block), n
                if rows[column] >= 0:
                    prefetch_element(evidence.labeled, rows[column], n)
        # separate passes; each pass prefetches the memory of the next pass
        for column in range(columns):
            voxel = evidence.labeled[rows[column], voxels[column]] if rows[column] >= 0 else np.int32(-1)
            voxels[column] = voxel
            if voxel >= 0:
                prefetch_element(evidence.instance_ids, voxel, 0)
        for column in range(columns):
            voxel = voxels[column]
            instance_ids[row, column] = best_instance(evidence, voxel) if voxel >= 0 else np.int32(0)


@device
def _add_run(count, list_id, label, offsets, clusters, seen, votes):
    """Add `count` pixels with the same cluster list and the same instance to the votes (N + 1, M + 1)."""
    column = np.searchsorted(seen, label) if label > 0 else seen.shape[0]
    votes[votes.shape[0] - 1, column] += count
    for entry in range(offsets[list_id], offsets[list_id + 1]):
        votes[clusters[entry], column] += count


@njit(cache=True, nogil=True, parallel=True)
def count_votes(points, instance_ids, stride, seen, votes):
    """Count the pixels of each cluster on each instance.

    Args:
        points: The lists of clusters at the pixels.
        instance_ids: The instance (h, w) at every stride-th pixel of every stride-th row, 0 = none.
        stride: The distance between the samples, px.
        seen: The instances (M,) in `instance_ids`, ascending.
        votes: The counts (CHUNKS, N + 1, M + 1), modified in place. The last row counts all pixels, and the last column
            is for pixels without an instance.
    """
    # count runs of pixels with the same list and instance, because incrementing a counter for each pixel is slower
    list_ids, offsets, clusters = points.list_ids, points.offsets, points.clusters
    rows = instance_ids.shape[0]
    for chunk in prange(CHUNKS):
        list_id, label, count = np.int32(0), np.int32(0), np.int32(0)
        for row in range(chunk * rows // CHUNKS, (chunk + 1) * rows // CHUNKS):
            for sample in range(instance_ids.shape[1]):
                i, found = list_ids[row * stride, sample * stride], instance_ids[row, sample]
                if i != list_id or found != label:
                    _add_run(count, list_id, label, offsets, clusters, seen, votes[chunk])
                    list_id, label, count = i, found, np.int32(0)
                count += np.int32(1)
        _add_run(count, list_id, label, offsets, clusters, seen, votes[chunk])
