"""Tests for motion blur."""

import numpy as np
import pytest

from framework.data import Camera
from framework.geometry import inverse
from framework.synthetic.rgbd_camera import blurred
from framework.synthetic.rgbd_camera_kernels import MAX_SAMPLES
from framework.synthetic.walk import look

CAMERA = Camera(96, 64, 80.0, 82.0, 47.3, 31.1)
POSE = look(np.array([0.3, -0.2, 1.4]), 0.4, -0.2, 0.1)


def moved(right=0.0, down=0.0, ahead=0.0, turn=0.0):
    """Return POSE (4, 4) after a translation along the camera axes, m, and a rotation by `turn` rad about y."""
    T = np.eye(4)
    T[:3, 3] = right, down, ahead
    c, s = np.cos(turn), np.sin(turn)
    T[0, 0], T[0, 2], T[2, 0], T[2, 2] = c, s, -s, c
    return POSE @ T


def exposed(color, depth, start, end):
    return blurred(color, np.asarray(depth, np.float32), CAMERA, POSE, start, end)


def noise():
    return np.random.default_rng(0).integers(0, 256, (*CAMERA.shape, 3)).astype(np.uint8)


def test_motion_blur_of_still_camera_is_identity():
    np.testing.assert_array_equal(exposed(noise(), np.full(CAMERA.shape, 2.0), POSE, POSE), noise())


@pytest.mark.parametrize("path", [3, 6])
def test_motion_blur_width_equals_pixel_displacement(path):
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    color[:, 48:] = 200
    half = path / 2 * 2.0 / CAMERA.fx  # m, displacement at a depth of 2 m
    row = exposed(color, np.full(CAMERA.shape, 2.0), moved(right=-half), moved(right=half))[32, :, 0].astype(float)
    between = np.flatnonzero((row > 0) & (row < 200))
    assert abs(len(between) - path) <= 1
    assert (np.diff(row) >= 0).all()
    assert abs(between.mean() - 47.5) <= 0.5, "expected a centered blur"
    assert np.diff(row).max() < 1.5 * 200 / path, "expected a uniform blur"


def test_motion_blur_decreases_with_distance():
    color = noise()
    color[..., 1:] = color[..., :1]
    depth = np.full(CAMERA.shape, 1.0)
    depth[:, 48:] = 8.0
    ends = moved(right=-0.03), moved(right=0.03)
    picture = exposed(color, depth, *ends)
    distant = exposed(color, np.full_like(depth, 8.0), *ends)
    np.testing.assert_array_equal(picture[:, 60:], distant[:, 60:])
    assert picture[8:-8, 8:40].std() < 0.6 * picture[8:-8, 60:88].std()


def test_motion_blur_averages_samples_along_pixel_path():
    """In the reference, each point is projected into the camera at the start and the end of the exposure."""
    rng = np.random.default_rng(1)
    color, depth = noise(), rng.uniform(0.8, 4, CAMERA.shape)
    depth[rng.random(CAMERA.shape) < 0.05] = 0
    start, end = moved(-0.02, 0.01, -0.03, -0.01), moved(0.02, -0.02, 0.02, 0.015)
    picture = exposed(color, depth, start, end)
    lengths = []
    for v in range(CAMERA.height):
        for u in range(CAMERA.width):
            z = depth[v, u]
            point = np.array([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z, 1.0])
            path = []
            for T in (start, end):
                x, y, ahead, _ = inverse(T) @ POSE @ point
                path.append((CAMERA.fx * x / ahead + CAMERA.cx, CAMERA.fy * y / ahead + CAMERA.cy) if z else (u, v))
            (u0, v0), (u1, v1) = path
            length = np.hypot(u1 - u0, v1 - v0)
            lengths.append(length)
            if length < 0.5:
                np.testing.assert_array_equal(picture[v, u], color[v, u])
                continue
            count = min(int(np.ceil(length)) + 1, MAX_SAMPLES)
            mean = np.zeros(3)
            for k in range(count):
                f = (k + 0.5) / count
                x = np.clip(u0 + f * (u1 - u0), 0, CAMERA.width - 1)
                y = np.clip(v0 + f * (v1 - v0), 0, CAMERA.height - 1)
                i, j = min(int(x), CAMERA.width - 2), min(int(y), CAMERA.height - 2)
                upper = (1 - x + i) * color[j, i] + (x - i) * color[j, i + 1]
                lower = (1 - x + i) * color[j + 1, i] + (x - i) * color[j + 1, i + 1]
                mean += ((1 - y + j) * upper + (y - j) * lower) / count
            assert np.abs(picture[v, u] - mean).max() < 0.6, (u, v)
    assert np.mean(np.array(lengths) > 1) > 0.5
