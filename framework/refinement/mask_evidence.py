"""What the place of a point in a mask or beside it says about the object."""

from __future__ import annotations

import numpy as np

from framework.data import Float32
from framework.refinement.neighborhood import Neighborhoods


def mask_log_odds(around: Neighborhoods, largest: float, expected_bleed: float) -> Float32:
    """(S,) log-odds of each point for the object: `largest` deep in the mask, as much against it in the ring.

    Between them runs a linear ramp, whose zero lies `expected_bleed` widths of the ring inside of the mask's border. A
    mask too thin for the whole ramp gets a shorter one, so that its innermost points always speak for the object.
    """
    reach = np.maximum(np.minimum(around.ring_widths, around.mask_radii), 1).astype(np.float32)
    ramp = (around.depth_in_mask / reach[around.owner] - expected_bleed) / (1 - expected_bleed)
    return np.asarray(largest * np.clip(ramp, -1, 1), np.float32)
