"""Detection of depth images with other values than depth along z.

Some simulators store the distance to the camera center, and stereo cameras the disparity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.rigid_residual import along_z, rays, residuals_of
from framework.data import Camera, Float64

# maximum ratio of the residuals with another reading and with depth along z; valid recordings have at least 2.5, and
# recordings with another kind of depth at most 0.5
MAX_RATIO = 0.65


def _along_ray(camera: Camera, pixels: Float64, values: Float64) -> Float64:
    return along_z(camera, pixels, values / np.linalg.norm(rays(camera, pixels), axis=1))


def _inverse(camera: Camera, pixels: Float64, values: Float64) -> Float64:
    return along_z(camera, pixels, 1 / values)


KINDS = {
    "distances to the camera center; divide each value by sqrt(1 + ((u - cx) / fx)^2 + ((v - cy) / fy)^2)": _along_ray,
    "inverse depth or disparities, which increase toward the camera; convert them to depth in mm": _inverse,
}


def check_depth_kind(pairs: Sequence[MatchedPair]) -> Finding | None:
    """Return an error if depth images contain another kind of values than depth along z, or None."""
    found = residuals_of(pairs, [along_z, *KINDS.values()])
    if found is None or (best := int(found.ratios.argmin())) == 0 or found.ratios[best] > MAX_RATIO:
        return None
    text = (
        f"expected depth along z, got {list(KINDS)[best - 1]} (residual of a rigid motion between frames: "
        f"{found.medians[0]:.1%} of the depth, and {found.medians[best]:.1%} after conversion)"
    )
    return Finding(Verdict.ERROR, "depth", text)
