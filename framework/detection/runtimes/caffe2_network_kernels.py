"""Kernels of caffe2_network.py. A module without torch, because kernel compilation should not load torch."""

from __future__ import annotations

import numpy as np
from numba import njit

MAX_UINT8 = 255  # largest uint8


@njit(cache=True, nogil=True)
def round_to_bytes(values, rounded, per_unit, zero_point):
    """Write `values` (N,) * per_unit + zero_point to `rounded` (N,) uint8, rounded to nearest and clamped to 0..255.

    One pass replaces five passes in torch.
    """
    for i in range(values.shape[0]):
        nearest = np.rint(values[i] * per_unit + zero_point)
        rounded[i] = np.uint8(np.int32(min(max(nearest, np.float32(0)), np.float32(MAX_UINT8))))
