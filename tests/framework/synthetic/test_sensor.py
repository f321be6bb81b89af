"""The readings have the published statistics."""

import numpy as np
import pytest

from framework.data import Camera
from framework.synthetic.sensor import DepthSensor, axial_sigma, depth_step

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FRONT = np.ones(CAMERA.shape, np.float32)


def measure(depth, incidence=FRONT, noise=1.0, seed=0, max_range=8.0):
    sensor = DepthSensor(noise, max_range)
    return sensor.measure(np.asarray(depth, np.float32), incidence, CAMERA, np.random.default_rng([seed]))


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 4.0])
def test_the_deviation_on_a_wall_is_that_of_nguyen_et_al(z):
    # Spread over two depth steps, so that the wall's place among the steps does not matter.
    depth = z + np.linspace(-1, 1, FRONT.size).reshape(FRONT.shape) * float(depth_step(np.float32(z)))
    error = (measure(depth) - depth)[measure(depth) > 0]
    expected = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert error.std() == pytest.approx(expected, rel=0.05)
    assert abs(error.mean()) < 0.05 * expected


def test_grazing_surfaces_are_noisier():
    wall = np.full(FRONT.shape, 2.0)
    slanted = measure(wall, np.full(FRONT.shape, np.cos(np.deg2rad(72)), np.float32))
    theta = np.float32(np.deg2rad(72))
    assert axial_sigma(np.float32(2), theta) > 1.05 * axial_sigma(np.float32(2), np.float32(0))
    assert slanted[slanted > 0].std() > 1.05 * measure(wall).std()


def test_depth_comes_in_steps_of_an_eighth_of_a_disparity():
    reading = measure(np.full(FRONT.shape, 3.0))
    inverse = np.unique(1 / reading[reading > 0].astype(np.float64))
    np.testing.assert_allclose(np.diff(inverse) * 8 * 580 * 0.075, np.rint(np.diff(inverse) * 348), atol=0.02)
    assert depth_step(np.float32(3.0)) == pytest.approx(9 / 348)


def test_a_box_casts_the_projectors_shadow_to_its_left():
    depth = np.full(FRONT.shape, 3.0)
    depth[:, 150:200] = 1.0
    missing = np.mean([measure(depth, seed=s) == 0 for s in range(20)], axis=(0, 1))
    shadow = 262.5 * 0.075 * (1 / 1.0 - 1 / 3.0)  # px, 13.1
    assert (missing[150 - int(shadow) + 2 : 149] > 0.99).all()
    assert (missing[: 150 - int(shadow) - 3] < 0.01).all()
    assert (missing[203:] < 0.01).all()
    assert 0.2 < missing[199:201].mean() < 0.8  # the right edge drops readings by chance


def test_what_is_seen_edge_on_is_not_read():
    assert not measure(np.full(FRONT.shape, 2.0), np.full(FRONT.shape, 0.01, np.float32)).any()


def test_range():
    assert not measure(np.full(FRONT.shape, 0.3)).any()
    assert not measure(np.full(FRONT.shape, 5.0), max_range=4.5).any()
    assert not measure(np.full(FRONT.shape, 5.0), noise=0.0, max_range=4.5).any()


def test_no_noise_is_exact():
    depth = np.random.default_rng(0).uniform(0.1, 4, FRONT.shape).astype(np.float32)
    np.testing.assert_array_equal(measure(depth, noise=0.0), depth)


def test_half_the_noise_has_about_half_the_deviation():
    wall = 3.0 + np.linspace(-1, 1, FRONT.size).reshape(FRONT.shape) * 0.05
    half, full = ((measure(wall, noise=n) - wall).std() for n in (0.6, 1.0))
    assert half == pytest.approx(0.6 * full, rel=0.2)
