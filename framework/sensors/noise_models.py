"""How far a structured-light camera's depth is off: axial noise as measured on a Kinect, for kernels.

Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012, have
two formulas for the standard deviation (m) of depth z (m): one for surfaces that face the camera, and one that adds a
term over the angle of incidence theta. Both are here, the first in either precision. They multiply in different orders,
which is a matter of the last digit, and of maps that stay as they were.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LEAST, NEAR, GROWTH = 0.0012, 0.4, 0.0019  # m, m, 1 / m
SLANT = 0.0001  # m^1.5
LARGEST_THETA = np.float32(np.deg2rad(80))  # the model was fitted up to here and then diverges

# fastmath is said: numba lets a function that does not say it have that of whoever calls it first, and caches it so
device = njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath=False, _nrt=False)


@device
def axial_sigma(z: float) -> float:
    """sigma(z) in double precision."""
    return LEAST + GROWTH * (z - NEAR) ** 2


@device
def axial_sigma_single(z: np.float32) -> np.float32:
    """sigma(z) in single precision."""
    return np.float32(LEAST) + np.float32(GROWTH) * (z - np.float32(NEAR)) * (z - np.float32(NEAR))


@device
def axial_sigma_at_angle(z: np.float32, theta: np.float32) -> np.float32:
    """sigma(z, theta) in single precision, theta in rad."""
    theta = min(theta, LARGEST_THETA)
    beyond = z - np.float32(NEAR)
    upright = np.float32(np.pi / 2) - theta
    slant = np.float32(SLANT) / np.sqrt(max(z, np.float32(0.1))) * (theta * theta) / (upright * upright)
    return np.float32(np.float32(LEAST) + np.float32(GROWTH) * (beyond * beyond) + slant)
