"""Kernels of noise_models.py.

The noise model is a `DepthNoise`, or another named tuple with the fields `least`, `near` and `growth`. Do not change
the order of multiplications. Otherwise, results differ in the last digit, and maps are no longer byte-identical.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.sensors.noise_models import FLOOR, DepthNoise, SensorKind

LARGEST_THETA = np.float32(np.deg2rad(80))  # maximum angle of the fits, rad; the models diverge at larger angles

_KINECT_V1 = SensorKind.KINECT_V1.noise

# explicit fastmath: without it, numba compiles the function with the flags of its first caller;
# not stored: these functions are part of each kernel that calls them
device = njit(nogil=True, forceinline=True, error_model="numpy", fastmath=False, _nrt=False)


@device
def axial_sigma(z: float, noise: DepthNoise) -> float:
    """Return the standard deviation, m, of a reading at depth `z`, m, on a surface that faces the camera."""
    return max(FLOOR, noise.least + noise.growth * (z - noise.near) ** 2)


@device
def axial_sigma_single(z: np.float32, noise: DepthNoise) -> np.float32:
    """Compute `axial_sigma` in single precision."""
    beyond = z - np.float32(noise.near)
    return max(np.float32(FLOOR), np.float32(noise.least) + np.float32(noise.growth) * beyond * beyond)


@device
def axial_sigma_at_angle(z: np.float32, theta: np.float32, noise: DepthNoise) -> np.float32:
    """Return the standard deviation, m, of a reading at depth `z`, m, on a slanted surface.

    `theta` is the angle between the surface and the image plane, rad.
    """
    theta = min(theta, LARGEST_THETA)
    beyond = z - np.float32(noise.near)
    upright = np.float32(np.pi / 2) - theta
    root = np.sqrt(max(z, np.float32(0.1)))
    scale = np.float32(noise.slant) / root + np.float32(noise.far_slant) * z * root
    slant = scale * (theta * theta) / (upright * upright)
    facing = np.float32(noise.least) + np.float32(noise.growth) * (beyond * beyond)
    return np.float32(max(np.float32(FLOOR), facing) + slant)


@device
def noise_ratio(z: float, noise: DepthNoise) -> float:
    """Return the ratio of the standard deviation at depth `z`, m, to that of a Kinect v1.

    The ratio is used to scale limits that were tuned for a Kinect v1.
    """
    return float(axial_sigma(z, noise) / axial_sigma(z, _KINECT_V1))
