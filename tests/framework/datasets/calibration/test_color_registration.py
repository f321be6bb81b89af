"""Tests for the registration of color images between two cameras at the same position."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.calibration.color_registration import ColorRegistration
from framework.errors import DataError

COLOR = Camera(1296 // 8, 968 // 8, 1170.2 / 8, 1169.1 / 8, 80.5, 60.2)
DEPTH = Camera(640 // 8, 480 // 8, 577.9 / 8, 576.5 / 8, 39.6, 29.4)


def ramp(camera: Camera) -> np.ndarray:
    """Return an image (H, W, 3) whose colors encode the viewing direction x / z, y / z of each pixel."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([128 + 200 * x, 128 + 200 * y, np.full_like(x, 77)], axis=-1)


def test_color_registration_matches_viewing_direction() -> None:
    image, registration = np.round(ramp(COLOR)).astype(np.uint8), ColorRegistration(COLOR, DEPTH)
    found, negative = registration.apply(image), registration.apply(255 - image)
    assert (
        np.abs(found[2:-2, 2:-2] - ramp(DEPTH)[2:-2, 2:-2]).max() < 1.2
    )  # gray levels; a shift by one pixel changes the color by 2.8
    both = (found + (255.0 - negative)) / 2  # OpenCV rounds 0.5 up; the mean of both cancels the bias
    assert np.abs((both - ramp(DEPTH))[2:-2, 2:-2].mean(axis=(0, 1))).max() < 0.02


def test_color_registration_to_same_camera_is_identity() -> None:
    image = np.random.default_rng(0).integers(0, 256, (*DEPTH.shape, 3)).astype(np.uint8)
    np.testing.assert_array_equal(ColorRegistration(DEPTH, DEPTH).apply(image), image)


def test_color_registration_downsampled_pixel_is_area_mean() -> None:
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    double = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    single = double.scaled(0.5)
    blocks = image.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(ColorRegistration(double, single).apply(image) - blocks).max() <= 0.5


def test_color_registration_outside_view_repeats_nearest_color() -> None:
    wide = Camera(32, 24, 10.0, 10.0, 15.5, 11.5)
    narrow = Camera(32, 24, 20.0, 20.0, 15.5, 11.5)
    image = np.zeros((24, 32, 3), np.uint8)
    image[:, :16], image[:, 16:] = 50, 200
    found = ColorRegistration(narrow, wide).apply(image)
    assert (found[:, :8] == 50).all()
    assert (found[:, 24:] == 200).all()


@pytest.mark.parametrize("color", [Camera(32, 24, 9e5, 9e5, 16, 12), Camera(40000, 24, 5000, 30, 16, 12)])
def test_color_registration_rejects_cameras_before_allocation(color: Camera) -> None:
    with pytest.raises(DataError, match="expected color and depth cameras of similar resolution"):
        ColorRegistration(color, DEPTH)
