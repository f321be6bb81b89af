"""Tests for the cameras of CameraInfo messages."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from framework.data import Camera
from framework.errors import DataError
from framework.importing.bags.ros_camera import is_rectified, ros_camera
from framework.importing.bags.ros_topics import Topics

K, P = [600.0, 0, 330, 0, 610, 250, 0, 0, 1], [517.0, 0, 318, 0, 0, 516, 255, 0, 0, 0, 1, 0]


def info(model: str = "plumb_bob", d: tuple[float, ...] = (), p: list[float] = P) -> SimpleNamespace:
    return SimpleNamespace(width=640, height=480, k=K, p=p, d=list(d), distortion_model=model)


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/rgb/image_rect_color", True),
        ("/camera/depth/image_rect_raw", True),
        ("/kinect2/qhd/image_color_rect/compressed", True),
        ("/zed/zed_node/rgb/color/rect/image", True),
        ("/depth/image_rect/compressedDepth", True),
        ("/rgb_rect/image", True),
        ("/camera/rect_color/image/compressed", True),
        ("/camera/rectified_left/image_mono", True),
        ("/rgb_rect/image_raw", False),
        ("/camera_unrect/image", False),
        ("/director/image", False),
        ("/zed/zed_node/rgb/color/raw/image", False),
        ("/camera/rgb/image_raw", False),
        ("/camera/color/image_raw/compressed", False),
        ("/camera/rgb/image_unrectified", False),
        ("/direct/image", False),
    ],
)
def test_is_rectified_reads_topic_names(topic: str, expected: bool) -> None:
    assert is_rectified(topic) is expected


@pytest.mark.parametrize(
    ("topic", "expected"),
    [("/depth_registered/image", True), ("/aligned_depth_to_color/image", True), ("/depth_unregistered/image", False)],
)
def test_topics_depth_is_registered_reads_topic_names(topic: str, expected: bool) -> None:
    assert Topics(depth=topic).depth_is_registered is expected


def test_ros_camera_rectified_images_use_p() -> None:
    assert ros_camera("info", info(d=(0.1,) * 5), True) == (Camera(640, 480, 517.0, 516.0, 318.0, 255.0), None)


def test_ros_camera_raw_images_use_k() -> None:
    assert ros_camera("info", info(), False) == (Camera(640, 480, 600.0, 610.0, 330.0, 250.0), None)


def test_ros_camera_without_p_or_distortion_uses_k() -> None:
    camera, _ = ros_camera("info", info(p=[0.0] * 12), True)
    assert camera.fx == 600
    with pytest.raises(DataError, match="info: expected a projection matrix P of the rectified images, got zeros"):
        ros_camera("info", info(d=(0.1,) * 5, p=[0.0] * 12), True)


@pytest.mark.parametrize(
    ("model", "d"), [("F-Theta", (0.1,) * 5), ("plumb_bob", (0.1,) * 6), ("equidistant", (np.nan,) * 4)]
)
def test_ros_camera_unsupported_lens_raises(model: str, d: tuple[float, ...]) -> None:
    with pytest.raises(DataError, match="info: expected"):
        ros_camera("info", info(model, d), False)


def test_ros_lens_inverse_model_maps_recorded_to_pinhole() -> None:
    """The polynomial of RealSense's inverse model maps a recorded point to the ray."""
    d = (0.2, -0.1, 0.003, -0.002, 0.01)
    _, lens = ros_camera("info", info("Inverse Brown Conrady", d), False)
    assert lens is not None
    matrix = np.reshape(K, (3, 3))
    recorded = np.array([0.3, -0.25])
    ray = cv2.projectPoints(np.array([[*recorded, 1.0]]), np.zeros(3), np.zeros(3), np.eye(3), np.array(d))[0].ravel()
    u, v = np.rint((matrix @ [*recorded, 1])[:2]).astype(int)
    image = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(image, (int(u), int(v)), 5, (255, 255, 255), -1)
    rows, columns = np.nonzero(lens.smooth(image)[..., 0] > 127)
    expected = (matrix @ [*ray, 1])[:2]
    assert np.abs(expected - (u, v)).max() > 3
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=1)


@pytest.mark.parametrize("size", [(640, 480), (320, 240)])
def test_ros_lens_undistorts_depth_of_any_size(size: tuple[int, int]) -> None:
    _, lens = ros_camera("info", info(d=(0.3, -0.2, 0, 0, 0)), False)
    assert lens is not None
    u, _ = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in size))
    moved = lens.exact(u + 1)
    scale = size[0] / 640
    row, column = round(100 * scale), round(500 * scale)
    x, y = (500 - 330) / 600, (100 - 250) / 610
    r2 = x * x + y * y
    assert moved[row, column] - 1 == pytest.approx(scale * (600 * x * (1 + 0.3 * r2 - 0.2 * r2 * r2) + 330), abs=1)
