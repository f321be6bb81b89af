"""What the place of a point in a mask or beside it says about the object."""

from __future__ import annotations

import numpy as np

from framework.data import Float32
from framework.refinement.mixtures.mask_evidence_kernels import ramps
from framework.refinement.neighborhood import Neighborhoods


def mask_log_odds(around: Neighborhoods, largest: float, expected_bleed: float) -> Float32:
    """(S,) log-odds of each point for the object: `largest` a ring's width deep in the mask, as much against outside.

    Between them runs a linear ramp, whose zero lies `expected_bleed` widths of the ring inside of the mask's border and
    which ends 1 - 2 `expected_bleed` widths outside of it. A mask too thin for the whole ramp gets a shorter one, so
    that its innermost points always speak for the object.
    """
    reach = np.maximum(np.minimum(around.ring_widths, around.mask_radii), 1).astype(np.float32)
    log_odds = np.empty(len(around.depth_in_mask), np.float32)
    ramps(
        around.depth_in_mask, around.starts, reach * np.float32(1 - expected_bleed), expected_bleed, largest, log_odds
    )
    return log_odds
