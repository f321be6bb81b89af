"""Kernels of refine.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Int32, Int64

PART = 8192  # number of rows that a thread processes at once


@njit(cache=True, nogil=True)
def part_starts(kept: Bool) -> Int64:
    """Return the number of kept rows (parts + 1,) before each part of PART rows, and in total."""
    parts = (len(kept) + PART - 1) // PART
    starts = np.zeros(parts + 1, np.int64)
    for part in range(parts):
        count = np.int32(0)
        for stays in kept[part * PART : (part + 1) * PART]:
            count += np.int32(stays)
        starts[part + 1] = starts[part] + count
    return starts


@njit(cache=True, nogil=True, parallel=True)
def compress(
    points: Float32, pixels: Int32, cluster: Int32, kept: Bool, starts: Int64, kept_points: Float32,
    kept_pixels: Int32, kept_cluster: Int32,
) -> None:  # fmt: skip
    """Copy the kept rows of three arrays to `kept_points`, `kept_pixels` and `kept_cluster`.

    `starts` comes from part_starts(). This is faster than Boolean indexing.
    """
    for part in prange(len(starts) - 1):
        k = starts[part]
        for i in range(part * PART, min((part + 1) * PART, len(kept))):
            if kept[i]:
                for a in range(3):
                    kept_points[k, a] = points[i, a]
                kept_pixels[k, 0], kept_pixels[k, 1] = pixels[i, 0], pixels[i, 1]
                kept_cluster[k] = cluster[i]
                k += 1
