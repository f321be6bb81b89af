"""Kernels of caffe2_network.py.

This module does not import torch, because kernel compilation should not load torch.
"""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit

MAX_UINT8 = 255  # largest uint8


@njit(cache=True, nogil=True)
def round_to_bytes(values, rounded, per_unit, zero_point):
    """Quantize values to uint8: scale, shift, round to nearest, and clamp to 0..255.

    Args:
        values: The values (N,).
        rounded: The output (N,), uint8.
        per_unit: The number of quantization steps per unit of the values.
        zero_point: The integer that represents 0.
    """
    for i in range(values.shape[0]):
        nearest = np.rint(values[i] * per_unit + zero_point)
        rounded[i] = np.uint8(np.int32(min(max(nearest, np.float32(0)), np.float32(MAX_UINT8))))
