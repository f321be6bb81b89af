"""What the place of a point in a mask or beside it says about the object."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Int64
from framework.refinement.neighborhood import Neighborhoods


def mask_log_odds(around: Neighborhoods, largest: float, expected_bleed: float) -> Float32:
    """(S,) log-odds of each point for the object: `largest` a ring's width deep in the mask, as much against outside.

    Between them runs a linear ramp, whose zero lies `expected_bleed` widths of the ring inside of the mask's border and
    which ends 1 - 2 `expected_bleed` widths outside of it. A mask too thin for the whole ramp gets a shorter one, so
    that its innermost points always speak for the object.
    """
    reach = np.maximum(np.minimum(around.ring_widths, around.mask_radii), 1).astype(np.float32)
    log_odds = np.empty(len(around.depth_in_mask), np.float32)
    _ramps(
        around.depth_in_mask, around.starts, reach * np.float32(1 - expected_bleed), expected_bleed, largest, log_odds
    )
    return log_odds


@njit(cache=True, nogil=True)
def _ramps(
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
