"""Tests for depth noise models, compared with the published formulas."""

import numpy as np
import pytest
from numba import njit

from framework.sensors.noise_models import DepthNoise, SensorChoice, SensorKind, kind_of_device
from framework.sensors.noise_models_kernels import (
    axial_sigma,
    axial_sigma_at_angle,
    axial_sigma_single,
    noise_ratio,
)

PUBLISHED = {  # m, standard deviation at depth z (m) on a frontal surface
    SensorKind.EXACT: lambda z: 0.001,  # the minimum for all models
    SensorKind.KINECT_V1: lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2,  # Nguyen et al.
    SensorKind.REALSENSE_D435: lambda z: z**2 * 0.08 / (424 * 0.05),  # Grunnet-Jepsen et al.
    SensorKind.TIME_OF_FLIGHT: lambda z: (1.5 - 0.5 * z + 0.3 * z**2) / 1000,  # Fankhauser et al.
    SensorKind.PHONE_LIDAR: lambda z: 0.01,  # Luetzenburg et al.
}


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 3.4])
@pytest.mark.parametrize("kind", SensorKind)
def test_depth_noise_matches_published_model(kind: SensorKind, z: float) -> None:
    right = PUBLISHED[kind](z)
    noise = kind.noise
    assert kind.sigma(z) == pytest.approx(right, rel=1e-12)
    assert axial_sigma(z, noise) == pytest.approx(right, rel=1e-12)
    assert axial_sigma_single(np.float32(z), noise) == pytest.approx(right, rel=1e-6)
    assert axial_sigma_at_angle(np.float32(z), np.float32(0), noise) == pytest.approx(right, rel=1e-6)
    assert noise_ratio(z, noise) == pytest.approx(right / PUBLISHED[SensorKind.KINECT_V1](z), rel=1e-12)


@pytest.mark.parametrize(
    ("kind", "slant"),
    [
        (SensorKind.KINECT_V1, lambda z: 0.0001 / np.sqrt(z)),
        (SensorKind.TIME_OF_FLIGHT, lambda z: 0.0001 * z**1.5),
        (SensorKind.PHONE_LIDAR, lambda z: 0.0),
    ],
)
@pytest.mark.parametrize("z", [0.6, 3.4])
def test_depth_noise_at_angle_matches_published_model(kind: SensorKind, slant, z: float) -> None:
    right = PUBLISHED[kind](z) + slant(z) / (np.pi / 2 - 1) ** 2
    assert axial_sigma_at_angle(np.float32(z), np.float32(1), kind.noise) == pytest.approx(right, rel=1e-5)


@pytest.mark.parametrize("kind", SensorKind)
def test_depth_noise_near_camera_is_at_least_1_mm(kind: SensorKind) -> None:
    for z in (0.0, 0.01, 0.2):
        assert axial_sigma(z, kind.noise) >= 0.001
        assert axial_sigma_single(np.float32(z), kind.noise) >= np.float32(0.001)


def test_depth_noise_of_kinect_is_byte_identical() -> None:
    """The operations have the same order as in earlier versions, so that maps are reproducible."""
    z = np.linspace(0.3, 9, 10_000, dtype=np.float32)
    beyond = z - np.float32(0.4)
    expected = np.float32(0.0012) + np.float32(0.0019) * beyond * beyond
    found = np.array([axial_sigma_single(one, SensorKind.KINECT_V1.noise) for one in z])
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal([noise_ratio(float(one), SensorKind.KINECT_V1.noise) for one in z], 1.0)


def test_depth_noise_rounding_is_independent_of_caller() -> None:
    """By default, Numba uses the fast-math setting of the first kernel that calls the function."""

    @njit(fastmath=True)
    def fill(z: np.ndarray, noise: DepthNoise, out: np.ndarray) -> None:
        for i in range(len(z)):
            out[i] = axial_sigma_single(z[i], noise)

    z = np.linspace(0.3, 9, 10_000, dtype=np.float32)
    found = np.empty_like(z)
    fill(z, SensorKind.KINECT_V1.noise, found)
    beyond = z - np.float32(0.4)
    np.testing.assert_array_equal(found, np.float32(0.0012) + np.float32(0.0019) * beyond * beyond)


def test_sensor_choices_are_kinds_and_auto() -> None:
    assert [choice.name for choice in SensorChoice] == ["AUTO", *SensorKind.__members__]
    assert SensorChoice.AUTO.kind(SensorKind.PHONE_LIDAR) is SensorKind.PHONE_LIDAR
    assert SensorChoice.EXACT.kind(SensorKind.PHONE_LIDAR) is SensorKind.EXACT


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("Intel RealSense D435I", SensorKind.REALSENSE_D435),
        ("Intel RealSense L515", SensorKind.TIME_OF_FLIGHT),
        ("Intel RealSense SR305", SensorKind.KINECT_V1),
        ("Orbbec Femto Bolt", SensorKind.TIME_OF_FLIGHT),
        ("Orbbec Gemini 335L", SensorKind.REALSENSE_D435),
        ("Orbbec Astra Pro", SensorKind.KINECT_V1),
        ("/camera/aligned_depth_to_color/image_raw", SensorKind.REALSENSE_D435),
        ("/device_0/sensor_0/Depth_0/image/data", SensorKind.REALSENSE_D435),
        ("/k4a/depth_to_rgb/image_raw", SensorKind.TIME_OF_FLIGHT),
        ("/kinect2/hd/image_depth_rect", SensorKind.TIME_OF_FLIGHT),
        ("/camera/depth_registered/image", None),
    ],
)
def test_kind_of_device_is_derived_from_name(name: str, kind: SensorKind | None) -> None:
    assert kind_of_device(name) is kind
