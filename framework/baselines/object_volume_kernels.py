"""Kernels of object_volume.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Float32, Int32
from framework.mapping.labels.vertex_labels_kernels import CHUNK, CORNERS, corner_voxels, keep_near
from framework.mapping.voxels.integration_parameters import Pinhole
from framework.mapping.voxels.raycasting_kernels import voxel_seen
from framework.mapping.voxels.voxel_grid import Grid
from framework.mapping.voxels.voxel_grid_kernels import device


class MaskCounts(NamedTuple):
    """What masks said of each voxel."""

    foreground: npt.NDArray[np.uint16]  # (B, 512) observations under a mask of the object
    observed: npt.NDArray[np.uint16]  # (B, 512) all of those in frames that had a mask of it; 65535 at most


@device
def _probability(foreground, observed):
    """The mean of Beta(1 + foreground, 1 + observed - foreground)."""
    one = np.float32(1.0)
    return (one + np.float32(foreground)) / (one + one + np.float32(observed))


@njit(cache=True, nogil=True, parallel=True)
def count_masks(seen, mask, counts):
    """Counts for the seen blocks' voxels near the measured surface whether `mask` (H, W) has their pixel."""
    foreground, observed = counts
    most = np.uint16(65535)
    inside = mask.ravel()
    for a in prange(seen.blocks.shape[0]):
        block = seen.blocks[a]
        first = seen.near_first[a]
        for i in range(first, first + seen.near_count[a]):
            n = seen.near_voxel[i]
            if observed[block, n] < most:
                observed[block, n] += np.uint16(1)
                foreground[block, n] += np.uint16(inside[seen.near_pixel[i]])


@njit(cache=True, nogil=True, parallel=True)
def look_up_object(
    grid: Grid,
    counts: MaskCounts,
    depth: Float32,
    view: Pinhole,
    stride: int,
    window: tuple[int, int, int, int],
    instance_id: int,
    instance_ids: Int32,
    best: Float32,
) -> None:
    """Sets instance_ids (h, w) to `instance_id` where every stride-th reading of every stride-th row of `depth` (H, W)
    m lies in a voxel that is more probably this object's than `best` (h, w), and that to its probability.

    `window` holds the first row and column of (h, w) and those after the last; `view` T_world_camera.
    """
    top, left, bottom, right = window
    for row in prange(top, bottom):
        key = np.int64(-2)
        region = np.int32(-1)
        for column in range(left, right):
            z = depth[row * stride, column * stride]
            if z > np.float32(0.0):
                block, n, key, region = voxel_seen(grid, view, column * stride, row * stride, z, key, region)
                if block >= 0:
                    probability = _probability(counts.foreground[block, n], counts.observed[block, n])
                    if probability > best[row, column]:
                        best[row, column] = probability
                        instance_ids[row, column] = instance_id


@njit(cache=True, nogil=True, parallel=True)
def foreground_at(grid, counts, points, probability):
    """Fills probability (P,) with that of the foreground at points (P, 3) m, from the counts of the voxels around."""
    for chunk in prange(-(-len(points) // CHUNK)):
        blocks, numbers = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        shares = np.empty(CORNERS, np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            corner_voxels(grid, points[p], blocks, numbers, shares)
            keep_near(grid, blocks, numbers, shares)
            foreground = observed = np.float32(0.0)
            for c in range(CORNERS):
                if shares[c] > 0:
                    foreground += shares[c] * np.float32(counts.foreground[blocks[c], numbers[c]])
                    observed += shares[c] * np.float32(counts.observed[blocks[c], numbers[c]])
            probability[p] = _probability(foreground, observed)
