"""Tests for undistortion, compared with OpenCV and with a pinhole camera."""

from __future__ import annotations

from dataclasses import astuple

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion, Undistortion
from framework.datasets.tum_rgbd import PUBLISHED, Intrinsics
from framework.errors import DataError
from framework.geometry import exp_se3
from tests.support.scenes.analytic_scene import CAMERA, room

LENS = Distortion(k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633)  # lens of freiburg1


@pytest.mark.parametrize("intrinsics", [Intrinsics.FREIBURG1, Intrinsics.FREIBURG2])
def test_distorted_matches_opencv(intrinsics: Intrinsics) -> None:
    camera, lens = PUBLISHED[intrinsics].camera, PUBLISHED[intrinsics].distortion
    assert lens is not None
    size = (camera.width, camera.height)
    u, v = cv2.initUndistortRectifyMap(camera.K, np.array(astuple(lens)), None, camera.K, size, cv2.CV_32FC1)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)
    found = lens.distorted(camera, pixels.astype(np.float64))
    np.testing.assert_allclose(found, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-3)


def recorded(camera: Camera, lens: Distortion, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth (H, W), m, and color (H, W, 3) of a camera with this lens."""
    wide = Camera(3 * camera.width, 3 * camera.height, 2 * camera.fx, 2 * camera.fy, 239.5, 179.5)
    depth, color, _ = room().render(wide, T_world_camera)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float64)
    rays = cv2.undistortPoints(
        pixels.reshape(-1, 1, 2), camera.K, np.array(astuple(lens)), criteria=(cv2.TERM_CRITERIA_COUNT, 50, 0)
    )
    u = (rays[:, 0, 0] * wide.fx + wide.cx).reshape(camera.shape).astype(np.float32)
    v = (rays[:, 0, 1] * wide.fy + wide.cy).reshape(camera.shape).astype(np.float32)
    return cv2.remap(depth, u, v, cv2.INTER_NEAREST), cv2.remap(color, u, v, cv2.INTER_LINEAR)


def test_undistortion_view_matches_pinhole_view() -> None:
    T = exp_se3(np.array([0.1, 0.0, 0.0, 0.1, -0.2, 0.1]))
    depth, color = recorded(CAMERA, LENS, T)
    true_depth, true_color, surface = room().render(CAMERA, T)
    inside = np.ones(CAMERA.shape, bool)
    inside[:6], inside[-6:], inside[:, :6], inside[:, -6:] = (
        False,
        False,
        False,
        False,
    )  # the border is outside of the distorted image
    edges = cv2.dilate(cv2.Laplacian(surface.astype(np.float32), cv2.CV_32F), np.ones((7, 7))) != 0
    kept = inside & ~edges & (true_depth > 0)
    undistortion = Undistortion(CAMERA, LENS)
    before = np.abs(color.astype(int) - true_color)[kept].mean()
    after = np.abs(undistortion.smooth(color).astype(int) - true_color)[kept].mean()
    assert after < 1 < before
    off, was = (np.abs(z - true_depth)[kept] for z in (undistortion.exact(depth), depth))
    assert np.percentile(off, 90) < np.percentile(was, 90) / 4  # `exact` uses the nearest pixel


def test_undistortion_exact_mode_does_not_mix_labels() -> None:
    labels = np.random.default_rng(0).choice(np.array([0, 7, 300], np.uint16), CAMERA.shape)
    undistorted = Undistortion(CAMERA, LENS).exact(labels)
    assert undistorted.dtype == np.uint16
    assert set(np.unique(undistorted)) == {0, 7, 300}


def test_undistortion_outside_image_is_zero() -> None:
    pincushion = Undistortion(CAMERA, Distortion(k1=0.5))
    ones = pincushion.exact(np.ones(CAMERA.shape, np.float32))
    assert ones[0, 0] == 0
    assert ones[60, 80] == 1
    assert (pincushion.smooth(np.full((*CAMERA.shape, 3), 9, np.uint8))[0, 0] == 0).all()


def test_undistortion_without_distortion_keeps_image_unchanged() -> None:
    color = np.random.default_rng(0).integers(0, 256, (*CAMERA.shape, 3), np.uint8)
    assert np.array_equal(Undistortion(CAMERA, Distortion()).smooth(color), color)


def test_undistortion_implausible_coefficients_raise() -> None:
    with pytest.raises(DataError, match=r"at most 80 px in the 160x120 image, got \d+ px"):
        Undistortion(CAMERA, Distortion(k1=10.0))
    with pytest.raises(DataError, match="expected finite coefficients"):
        Distortion(k1=float("nan"))
