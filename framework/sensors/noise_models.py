"""Axial noise of a structured-light camera: standard deviation (m) of depth z (m), for kernels.

The model is from Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking",
3DIMPVT 2012. One formula is for surfaces that face the camera, in double and single precision. Another formula has a
term for the angle of incidence theta. Do not change the order of multiplications: results would differ in the last
digit, and maps would no longer be byte-identical.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LEAST, NEAR, GROWTH = 0.0012, 0.4, 0.0019  # m, m, 1 / m
SLANT = 0.0001  # m^1.5
LARGEST_THETA = np.float32(np.deg2rad(80))  # limit of the fit; the model diverges at larger angles

# explicit fastmath: without it, numba caches the function with the flags of its first caller
device = njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath=False, _nrt=False)


@device
def axial_sigma(z: float) -> float:
    """Return sigma(z) in m, in double precision."""
    return LEAST + GROWTH * (z - NEAR) ** 2


@device
def axial_sigma_single(z: np.float32) -> np.float32:
    """Return sigma(z) in m, in single precision."""
    return np.float32(LEAST) + np.float32(GROWTH) * (z - np.float32(NEAR)) * (z - np.float32(NEAR))


@device
def axial_sigma_at_angle(z: np.float32, theta: np.float32) -> np.float32:
    """Return sigma(z, theta) in m, in single precision, with theta in rad."""
    theta = min(theta, LARGEST_THETA)
    beyond = z - np.float32(NEAR)
    upright = np.float32(np.pi / 2) - theta
    slant = np.float32(SLANT) / np.sqrt(max(z, np.float32(0.1))) * (theta * theta) / (upright * upright)
    return np.float32(np.float32(LEAST) + np.float32(GROWTH) * (beyond * beyond) + slant)
