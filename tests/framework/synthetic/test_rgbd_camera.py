"""Tests for the simulated depth sensor, compared with published noise models."""

import numpy as np
import pytest

from framework.data import Camera
from framework.sensors.noise_models import SensorKind
from framework.sensors.noise_models_kernels import axial_sigma_at_angle
from framework.synthetic.rgbd_camera import (
    PATCH,
    TRIANGULATION,
    DepthSensor,
    noisy_color,
    normal_quantiles,
    random_bits,
)
from framework.synthetic.rgbd_camera_kernels import depth_step

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FRONT = np.ones(CAMERA.shape, np.float32)
KINECT = SensorKind.KINECT_V1
STEPS = np.float32(TRIANGULATION[KINECT].steps_depth)


def measure(depth, incidence=FRONT, noise=1.0, seed=0, max_range=8.0, kind=KINECT):
    sensor = DepthSensor(noise, max_range, kind)
    return sensor.measure(np.asarray(depth, np.float32), incidence, CAMERA, np.random.default_rng([seed]))


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 4.0])
def test_depth_noise_deviation_matches_nguyen_model(z):
    # the wall extends over two depth steps, so that its position relative to the steps has no effect
    depth = z + np.linspace(-1, 1, FRONT.size).reshape(FRONT.shape) * float(depth_step(np.float32(z), STEPS))
    error = (measure(depth) - depth)[measure(depth) > 0]
    expected = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert error.std() == pytest.approx(expected, rel=0.05)
    assert abs(error.mean()) < 0.05 * expected


@pytest.mark.parametrize("z", [0.8, 2.5])
@pytest.mark.parametrize("kind", [SensorKind.REALSENSE_D435, SensorKind.TIME_OF_FLIGHT, SensorKind.PHONE_LIDAR])
def test_depth_noise_deviation_matches_sensor_model(kind, z):
    wall = np.full(FRONT.shape, z)
    error = (measure(wall, kind=kind) - wall)[measure(wall, kind=kind) > 0]
    assert error.size == FRONT.size
    assert error.std() == pytest.approx(kind.sigma(z), rel=0.05)
    assert abs(error.mean()) < 0.05 * kind.sigma(z)


def test_depth_of_exact_sensor_has_no_noise():
    depth = np.random.default_rng(0).uniform(0.1, 4, FRONT.shape).astype(np.float32)
    np.testing.assert_array_equal(measure(depth, kind=SensorKind.EXACT), depth)


def test_time_of_flight_depth_has_no_projector_shadow():
    depth = np.full(FRONT.shape, 3.0)
    depth[:, 150:200] = 1.0
    left = np.s_[:, 138:148]  # in the shadow of the projector of a Kinect
    assert not measure(depth)[left].any()
    assert measure(depth, kind=SensorKind.TIME_OF_FLIGHT)[left].all()


def test_depth_noise_increases_at_grazing_angles():
    wall = np.full(FRONT.shape, 2.0)
    slanted = measure(wall, np.full(FRONT.shape, np.cos(np.deg2rad(72)), np.float32))
    theta = np.float32(np.deg2rad(72))
    upright, tilted = (axial_sigma_at_angle(np.float32(2), angle, KINECT.noise) for angle in (np.float32(0), theta))
    assert tilted > 1.05 * upright
    assert slanted[slanted > 0].std() > 1.05 * measure(wall).std()


def test_depth_is_quantized_to_eighth_disparity_steps():
    reading = measure(np.full(FRONT.shape, 3.0))
    inverse = np.unique(1 / reading[reading > 0].astype(np.float64))
    np.testing.assert_allclose(np.diff(inverse) * 8 * 580 * 0.075, np.rint(np.diff(inverse) * 348), atol=0.02)
    assert depth_step(np.float32(3.0), STEPS) == pytest.approx(9 / 348)


def test_depth_sensor_box_casts_projector_shadow_on_left():
    depth = np.full(FRONT.shape, 3.0)
    depth[:, 150:200] = 1.0
    missing = np.mean([measure(depth, seed=s) == 0 for s in range(20)], axis=(0, 1))
    shadow = 262.5 * 0.075 * (1 / 1.0 - 1 / 3.0)  # 13.1 px
    assert (missing[150 - int(shadow) + 2 : 149] > 0.99).all()
    assert (missing[: 150 - int(shadow) - 3] < 0.01).all()
    assert (missing[203:] < 0.01).all()
    assert 0.2 < missing[199:201].mean() < 0.8  # at the right edge, depth is dropped at random


def test_depth_sensor_surface_seen_edge_on_has_no_reading():
    assert not measure(np.full(FRONT.shape, 2.0), np.full(FRONT.shape, 0.01, np.float32)).any()


def test_depth_sensor_out_of_range_has_no_reading():
    assert not measure(np.full(FRONT.shape, 0.3)).any()
    assert not measure(np.full(FRONT.shape, 5.0), max_range=4.5).any()
    assert not measure(np.full(FRONT.shape, 5.0), noise=0.0, max_range=4.5).any()


def test_depth_sensor_without_noise_is_exact():
    depth = np.random.default_rng(0).uniform(0.1, 4, FRONT.shape).astype(np.float32)
    np.testing.assert_array_equal(measure(depth, noise=0.0), depth)


def test_depth_noise_deviation_scales_with_noise_parameter():
    wall = 3.0 + np.linspace(-1, 1, FRONT.size).reshape(FRONT.shape) * 0.05
    half, full = ((measure(wall, noise=n) - wall).std() for n in (0.6, 1.0))
    assert half == pytest.approx(0.6 * full, rel=0.2)


def test_normal_quantiles_match_normal_distribution():
    quantiles = normal_quantiles().astype(float)
    assert quantiles.mean() == pytest.approx(0, abs=1e-6)
    assert quantiles.std() == pytest.approx(1, abs=1e-6)
    assert (quantiles**4).mean() == pytest.approx(3, abs=0.02)
    for sigmas, share in ((1, 0.6827), (2, 0.9545), (3, 0.9973)):
        assert (np.abs(quantiles) < sigmas).mean() == pytest.approx(share, abs=5e-4)


def test_random_bits_are_unbiased_and_seeded():
    bits = random_bits((100, 101, 3), np.random.default_rng(0))
    assert bits.shape == (100, 101, 3)
    for k in range(16):
        assert np.mean(bits >> k & 1) == pytest.approx(0.5, abs=0.01)
    np.testing.assert_array_equal(bits, random_bits((100, 101, 3), np.random.default_rng(0)))


# Kernels compared with operations on whole images


def jagged(seed):
    """Return depth (H, W), m, with steps, noise and holes, and the cosines of incidence (H, W)."""
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.2, 7, (CAMERA.height // 8, CAMERA.width // 8)).astype(np.float32)
    depth = np.kron(blocks, np.ones((8, 8), np.float32))
    depth *= rng.uniform(0.97, 1.03, depth.shape).astype(np.float32)
    depth[rng.random(depth.shape) < 0.05] = 0
    cosine = rng.uniform(0, 1.0001, depth.shape).astype(np.float32)
    cosine[depth == 0] = 0
    return depth, cosine


def slow_measure(depth, incidence, noise, max_range, rng):
    """Return the measured depth (H, W), m, computed on whole images."""
    exact = np.where(depth <= max_range, depth, np.float32(0))
    disparity = np.where(depth > 0, np.float32(CAMERA.fx * 0.075) / np.maximum(depth, np.float32(0.1)), 0)
    place = np.arange(CAMERA.width, dtype=np.float32)[None, :] - disparity
    hidden = place > np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1] + np.float32(1)
    at_step = np.zeros(depth.shape, np.bool_)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = np.abs(depth[a] - depth[b]) > np.float32(0.05) * np.minimum(depth[a], depth[b])
        at_step[a] |= step
        at_step[b] |= step
    theta = np.arccos(np.minimum(incidence, np.float32(1)))
    bits = random_bits((*depth.shape, 4), rng)
    chance = bits[..., 0] / np.float32(65536)
    lateral_v, lateral_u, axial = (normal_quantiles()[bits[..., k] >> 4] for k in (1, 2, 3))
    start, end = np.deg2rad(80.0), np.deg2rad(88.0)
    grazing = (theta - np.float32(start)) / np.float32(end - start)
    lost = chance < min(noise, 1.0) * np.maximum(np.where(at_step, np.float32(0.5), np.float32(0)), grazing)
    pixel = np.float32(noise * 0.8 * CAMERA.width / 640)
    v = np.clip(np.arange(CAMERA.height)[:, None] + np.rint(pixel * lateral_v).astype(int), 0, CAMERA.height - 1)
    u = np.clip(np.arange(CAMERA.width)[None, :] + np.rint(pixel * lateral_u).astype(int), 0, CAMERA.width - 1)
    neighbor = depth[v, u]
    z = np.where((np.abs(neighbor - depth) > np.float32(0.05) * depth) & (neighbor > 0), neighbor, depth)
    t = np.minimum(theta, np.float32(np.deg2rad(80)))
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(np.maximum(z, 0.1)) * t**2 / (np.pi / 2 - t) ** 2
    scale = np.float32(8 * 580 * 0.075)
    variance = (noise * sigma) ** 2 - (z * z / scale) ** 2 / 12
    noisy = z + np.sqrt(np.maximum(variance, 0)) * axial
    reading = scale / np.maximum(np.rint(scale / np.maximum(noisy, np.float32(0.1))), 1)
    assert reading.dtype == np.float32
    valid = (exact > 0.4) & ~hidden & ~lost & (reading > 0.4) & (reading <= max_range)
    return np.where(valid, reading, np.float32(0))


@pytest.mark.parametrize("noise", [0.3, 1.0, 1.7])
def test_depth_sensor_equals_vectorized_reference(noise):
    for seed in range(3):
        depth, cosine = jagged(seed)
        expected = slow_measure(depth, cosine, noise, 6.0, np.random.default_rng([seed]))
        assert 0.1 < np.mean(expected > 0) < 0.9
        np.testing.assert_array_equal(measure(depth, cosine, noise, seed, 6.0), expected)


def test_color_noise_is_rounded_and_clipped():
    color = np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.uint8)
    grain = normal_quantiles()[random_bits(color.shape, np.random.default_rng(1)) >> 4]
    for noise in (1.0, 40.0):  # gray levels below 0 and above 255
        expected = np.clip(np.rint(color + np.float32(noise * 1.5) * grain), 0, 255).astype(np.uint8)
        np.testing.assert_array_equal(noisy_color(color, noise, np.random.default_rng(1)), expected)
    assert noisy_color(color, 0.0, np.random.default_rng(1)) is color


# Dark and shiny surfaces


def measure_unread(unread, noise=1.0, seed=0):
    wall = np.full(FRONT.shape, 2.0, np.float32)
    unread = np.broadcast_to(np.float32(unread), FRONT.shape)
    return DepthSensor(noise, 8.0).measure(wall, FRONT, CAMERA, np.random.default_rng([seed]), unread)


def slow_loss(unread, noise, seed):
    """Return the mask (H, W) of the dropped pixels. Interpolated noise is compared with the dropout rate."""
    rng = np.random.default_rng([seed])
    random_bits((*FRONT.shape, 4), rng)  # the random numbers of the other dropout
    cell = PATCH * CAMERA.width / 640
    rows, columns = (int(side / cell) + 2 for side in FRONT.shape)
    nodes = normal_quantiles()[random_bits((rows, columns), rng) >> 4].astype(float)
    y, x = np.arange(CAMERA.height) / cell, np.arange(CAMERA.width) / cell
    of_rows = np.maximum(0, 1 - np.abs(y[:, None] - np.arange(rows)))
    of_columns = np.maximum(0, 1 - np.abs(x[:, None] - np.arange(columns)))
    deviation = np.sqrt((of_rows**2).sum(axis=1)[:, None] * (of_columns**2).sum(axis=1))
    quantile = np.append(normal_quantiles(), np.inf)[(min(noise, 1) * unread * 4096).astype(int)]
    return (of_rows @ nodes @ of_columns.T / deviation < quantile) & (unread >= 1 / 4096)


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_material_dropout_matches_slow_reference(noise):
    unread = np.random.default_rng(7).uniform(-0.3, 1.2, FRONT.shape).clip(0, 1).astype(np.float32)
    for seed in range(2):
        without = measure(np.full(FRONT.shape, 2.0), noise=noise, seed=seed)
        found = measure_unread(unread, noise, seed)
        expected = np.where(slow_loss(unread, noise, seed), 0, without)
        assert 0.2 < (expected > 0).mean() < 0.9
        assert (found != expected).mean() < 1e-4, "expected differences only by rounding at the quantile"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_material_dropout_has_given_rate_and_forms_patches(share):
    lost = np.array([measure_unread(share, seed=seed) == 0 for seed in range(20)])
    assert lost.mean() == pytest.approx(share, abs=0.02)
    equal_neighbors = (lost[:, :, 1:] == lost[:, :, :-1]).mean()
    assert equal_neighbors > 1 - 0.3 * 2 * share * (1 - share), "expected neighbors to be dropped together"


def test_material_dropout_removes_only_unreadable_surfaces():
    assert not measure_unread(1.0).any()
    np.testing.assert_array_equal(measure_unread(0.0), measure(np.full(FRONT.shape, 2.0)))
    assert measure_unread(1.0, noise=0.0).all(), "expected no dropout without noise"
