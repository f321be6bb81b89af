"""Kernels of mask_evidence.py."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Int64


@njit(cache=True, nogil=True)
def ramps(
    depth_in_mask: Float32, starts: Int64, widths: Float32, expected_bleed: float, largest: float, log_odds: Float32
) -> None:
    zero = np.float32(expected_bleed / (1 - expected_bleed))
    for k in range(len(widths)):
        own = slice(starts[k], starts[k + 1])
        _ramp(depth_in_mask[own], np.float32(1) / widths[k], zero, np.float32(largest), log_odds[own])


@njit(cache=True, nogil=True)
def _ramp(depth_in_mask: Float32, scale: np.float32, zero: np.float32, largest: np.float32, log_odds: Float32) -> None:
    one = np.float32(1)
    for i in range(len(log_odds)):
        ramp = depth_in_mask[i] * scale - zero
        ramp = ramp if ramp < one else one
        log_odds[i] = largest * (ramp if ramp > -one else -one)
