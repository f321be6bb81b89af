"""Kernels of object_volume.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Int32, UInt16
from framework.mapping.labels.vertex_labels_kernels import CHUNK, CORNERS, corner_voxels, keep_near
from framework.mapping.voxels.integration_parameters import Pinhole
from framework.mapping.voxels.raycasting_kernels import voxel_seen
from framework.mapping.voxels.voxel_grid import Grid
from framework.mapping.voxels.voxel_grid_kernels import NO_LOOK_UP, device


class MaskCounts(NamedTuple):
    """Number of observations of each voxel in frames in which the object is detected."""

    foreground: UInt16  # (B, 512) number of observations inside a mask
    observed: UInt16  # (B, 512) number of all observations, at most 65535


@device
def _probability(foreground, observed):
    """Return the foreground probability, given the numbers of observations."""
    one = np.float32(1.0)  # mean of Beta(1 + foreground, 1 + observed - foreground)
    return (one + np.float32(foreground)) / (one + one + np.float32(observed))


@njit(cache=True, nogil=True, parallel=True)
def count_masks(seen, mask, counts):
    """Count the observations of the voxels near the measured surface, in total and inside the mask."""
    foreground, observed = counts
    largest = np.uint16(65535)
    inside = mask.ravel()
    for a in prange(seen.blocks.shape[0]):
        block = seen.blocks[a]
        start = seen.near_start[a]
        for i in range(start, start + seen.near_count[a]):
            n = seen.near_voxel[i]
            if observed[block, n] < largest:
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
    """Assign depth readings to an object where its foreground probability is the highest so far.

    Args:
        grid: The voxel grid of the object.
        counts: The numbers of observations of the object.
        depth: The depth image (H, W), m.
        view: The camera with the pose T_world_camera.
        stride: The distance between the used readings, px.
        window: The first row, first column, end row and end column of the samples to update.
        instance_id: The id of the object.
        instance_ids: The object (h, w) at each sample, modified in place.
        best: The highest foreground probability (h, w) at each sample, modified in place.
    """
    top, left, bottom, right = window
    for row in prange(top, bottom):
        key, region = NO_LOOK_UP
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
    """Interpolate the foreground probability (P,) at world points (P, 3), m."""
    for chunk in prange(-(-len(points) // CHUNK)):
        blocks, voxels = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        weights = np.empty(CORNERS, np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            corner_voxels(grid, points[p], blocks, voxels, weights)
            keep_near(grid, blocks, voxels, weights)
            foreground = observed = np.float32(0.0)
            for c in range(CORNERS):
                if weights[c] > 0:
                    foreground += weights[c] * np.float32(counts.foreground[blocks[c], voxels[c]])
                    observed += weights[c] * np.float32(counts.observed[blocks[c], voxels[c]])
            probability[p] = _probability(foreground, observed)
