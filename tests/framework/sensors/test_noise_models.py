"""Tests of the depth noise model of Nguyen et al."""

import numpy as np
import pytest
from numba import njit

from framework.sensors.noise_models import axial_sigma, axial_sigma_at_angle, axial_sigma_single


def test_depth_noise_rounding_is_independent_of_caller() -> None:
    """Without its own setting, numba would inherit fast math from the first calling kernel."""

    @njit(fastmath=True)
    def fill(z, out):  # type: ignore[no-untyped-def]
        for i in range(len(z)):
            out[i] = axial_sigma_single(z[i])

    z = np.linspace(0.3, 9, 10_000, dtype=np.float32)
    found = np.empty_like(z)
    fill(z, found)
    beyond = z - np.float32(0.4)
    np.testing.assert_array_equal(found, np.float32(0.0012) + np.float32(0.0019) * beyond * beyond)


@pytest.mark.parametrize("z", [0.4, 1.4, 3.4])
def test_depth_noise_matches_nguyen_model(z: float) -> None:
    right = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert axial_sigma(z) == pytest.approx(right, rel=1e-12)
    assert axial_sigma_single(np.float32(z)) == pytest.approx(right, rel=1e-6)
    assert axial_sigma_at_angle(np.float32(z), np.float32(0)) == pytest.approx(right, rel=1e-6)
    slant = 0.0001 / np.sqrt(z) / (np.pi / 2 - 1) ** 2
    assert axial_sigma_at_angle(np.float32(z), np.float32(1)) == pytest.approx(right + slant, rel=1e-5)
