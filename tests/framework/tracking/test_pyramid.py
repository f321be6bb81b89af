"""Tests for the image pyramid."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.geometry import back_project
from framework.sensors.noise_models import SensorKind
from framework.tracking import pyramid
from framework.tracking.pyramid import build_pyramid, is_coarse, is_scattered, model_intensities, normals_of

CAMERA = Camera(32, 24, 30.0, 31.0, 15.2, 11.7)


def test_pyramid_depth_does_not_mix_surfaces_or_holes() -> None:
    depth = np.float32([[1.0, 1.02, 1.0, 3.0], [0.0, 1.01, 3.0, 3.0], [0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 2.0, 2.0]])
    color = np.zeros((4, 4, 3), np.uint8)
    _, half, _ = build_pyramid(Camera(4, 4, 4.0, 4.0, 1.5, 1.5), depth, color, 1.0, 3)
    np.testing.assert_allclose(half.depth, [[1.01, 1.0], [0.0, 2.0]], rtol=1e-6)


def test_pyramid_pixel_center_is_mean_of_four_pixels() -> None:
    camera = Camera(9, 7, 8.0, 8.5, 3.7, 3.1)  # with an odd size, the last row and column are dropped
    depth = np.ones(camera.shape, np.float32)
    color = np.zeros((*camera.shape, 3), np.uint8)
    _, half, quarter = build_pyramid(camera, depth, color, 1.0, 3)
    for level, side in ((half, 2), (quarter, 4)):
        assert level.camera.shape == (7 // side, 9 // side) == level.depth.shape
        v, u = np.mgrid[:side, :side].reshape(2, -1)
        ones = np.ones(side * side, np.float32)
        four = back_project(camera, np.stack([u, v], axis=1).astype(np.int32), ones).mean(axis=0)
        one = back_project(level.camera, np.zeros((1, 2), np.int32), ones[:1])[0]
        np.testing.assert_allclose(one, four, atol=1e-6)


def test_pyramid_finest_scale_selects_first_level() -> None:
    camera = Camera(16, 8, 8.0, 8.0, 7.5, 3.5)
    images = np.ones(camera.shape, np.float32), np.full((*camera.shape, 3), 255, np.uint8)
    levels = build_pyramid(camera, *images, 0.5, 3)
    assert [level.camera.width for level in levels] == [8, 4, 2]
    np.testing.assert_allclose(levels[2].intensity, 1, atol=1e-6)


def test_model_intensities_close_single_pixel_holes() -> None:
    gray = np.array([[10, 20, 30, 0], [30, 40, 50, 0], [0, 0, 0, 0], [0, 70, 0, 0]], np.uint8)
    view = SimpleNamespace(color=np.repeat(gray[..., None], 3, axis=2), depth=(gray > 0).astype(np.float32))
    full, half, quarter = model_intensities(view, 3)
    np.testing.assert_allclose(full, np.where(gray > 0, gray / 255, -1), atol=1e-6)
    # a single mapped pixel is not sufficient
    np.testing.assert_allclose(half, [[25 / 255, 40 / 255], [-1, -1]], atol=1e-6)
    np.testing.assert_allclose(quarter, [[32.5 / 255]], atol=1e-6)


def slope(step: float, nearest: float) -> np.ndarray:
    """Return depth (120, 160), m, from `nearest` to 4 m, rounded down to multiples of `step` unless `step` is 0."""
    depth = np.broadcast_to(np.linspace(nearest, 4, 160), (120, 160)) + np.linspace(0, 0.02, 120)[:, None]
    return (np.floor(depth / step) * step if step else depth).astype(np.float32)


@pytest.mark.parametrize("nearest", [0.6, 1.0, 2.0])
def test_is_coarse_detects_eight_bit_depth(nearest: float) -> None:
    assert is_coarse(slope(0.0392, nearest), otherwise=False)
    disparity = 8 * 580 * 0.075 / slope(0, nearest)  # depth of a Kinect, in disparity steps of 1/8 px
    kinect = (8 * 580 * 0.075 / np.rint(disparity)).astype(np.float32)
    for fine in (slope(0.001, nearest), slope(0, nearest), kinect):
        assert not is_coarse(fine, otherwise=True)


@pytest.mark.parametrize("otherwise", [True, False])
def test_is_coarse_of_constant_depth_returns_default(otherwise: bool) -> None:
    assert is_coarse(np.full((120, 160), 1.0, np.float32), otherwise) == otherwise
    assert is_coarse(np.zeros((120, 160), np.float32), otherwise) == otherwise


def test_is_coarse_compares_steps_with_sensor_noise() -> None:
    steps = slope(0.0392, 0.6)
    assert is_coarse(steps, otherwise=False)
    assert not is_coarse(steps / np.float32(2), otherwise=True, sensor=SensorKind.PHONE_LIDAR)
    assert is_coarse(steps / np.float32(2), otherwise=False, sensor=SensorKind.TIME_OF_FLIGHT)


@pytest.mark.parametrize(("missing", "expected"), [(0.05, False), (0.3, True), (0.9, True)])
def test_is_scattered_detects_single_missing_pixels(missing: float, expected: bool) -> None:
    depth = np.ones((120, 160), np.float32)
    depth[:, :60] = 0  # a single large hole
    assert not is_scattered(depth)
    depth[np.random.default_rng(0).random(depth.shape) < missing] = 0
    assert is_scattered(depth) == expected
    assert not is_scattered(np.zeros_like(depth))


def plane_frame(n: np.ndarray, d: float) -> Frame:
    """Return a frame of the plane n . p = d (m) in the camera frame."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(CAMERA.shape)], axis=-1)
    return Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), (d / (rays @ n)).astype(np.float32), CAMERA)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.5, 0.4, 0.8)])
def test_normals_of_plane_are_exact(direction: tuple[float, float, float]) -> None:
    n = np.array(direction) / np.linalg.norm(direction)
    normals = normals_of(plane_frame(n, 1.5))
    assert normals.shape == (*CAMERA.shape, 3)
    np.testing.assert_allclose(normals[1:-1, 1:-1], np.broadcast_to(-n, (22, 30, 3)), atol=1e-4)
    for border in (normals[0], normals[-1], normals[:, 0], normals[:, -1]):
        assert not border.any()


def slow_normals(frame: Frame) -> np.ndarray:
    """Return the normals (H, W, 3) as cross products of the differences between neighboring points."""
    height, width = frame.depth.shape
    v, u = np.mgrid[:height, :width].reshape(2, -1).astype(np.int32)
    points = back_project(CAMERA, np.stack([u, v], axis=1), frame.depth.ravel()).reshape(height, width, 3)
    normals = np.zeros((height, width, 3))
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            z = frame.depth[v, u]
            around = frame.depth[[v - 1, v + 1, v, v], [u, u, u - 1, u + 1]]
            if (around > 0).all() and (np.abs(around - z) <= 0.05 * z).all():
                n = np.cross(points[v + 1, u] - points[v - 1, u], points[v, u + 1] - points[v, u - 1])
                normals[v, u] = n / np.linalg.norm(n)
    return normals


def test_normals_of_frame_match_slow_reference() -> None:
    rng = np.random.default_rng(0)
    frame = plane_frame(np.array([0.1, 0.2, 0.97]), 1.5)
    noisy = frame.depth + rng.normal(0, 0.02, CAMERA.shape)  # some jumps exceed 5 % of the depth
    noisy[rng.random(CAMERA.shape) < 0.05] = 0
    frame = replace(frame, depth=noisy.astype(np.float32))
    expected = slow_normals(frame)
    assert 0.2 < expected.any(axis=-1).mean() < 0.8, "expected both known and unknown normals"
    np.testing.assert_allclose(normals_of(frame), expected, atol=1e-4)


def test_normals_of_frame_are_computed_once_for_all_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def compute(depth: np.ndarray, camera: Camera) -> np.ndarray:
        calls.append(depth)
        time.sleep(0.05)
        return np.zeros((3, *camera.shape), np.float32)

    monkeypatch.setattr(pyramid, "_normals", compute)
    frame = plane_frame(np.array([0.0, 0.0, 1.0]), 1.0)
    recolored = frame.with_color(np.full_like(frame.color, 255))
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(normals_of, [frame, recolored] * 4))
    assert len(calls) == 1
    assert all(normals is found[0] for normals in found)
    assert not found[0].flags.writeable
    normals_of(replace(frame, depth=frame.depth + np.float32(1)))
    assert len(calls) == 2, "expected new normals for another depth image"
