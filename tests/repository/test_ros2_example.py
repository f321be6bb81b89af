"""Tests for the ROS 2 node in examples/, with fake ROS modules."""

from __future__ import annotations

import importlib.util
import re
import sys
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from framework.datasets.tum_rgbd import TumRgbd
from tests.support.recordings.rvl_files import rvl

CHECKOUT = Path(__file__).resolve().parents[2]
DESK = TumRgbd(CHECKOUT / "data" / "desk", scene="rgbd_dataset_freiburg1_rpy")


class Message(SimpleNamespace):
    """Message whose fields are created on access."""

    DELETEALL, CUBE = 3, 1

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


class Node:
    """The methods of the node in rclpy that the example uses."""

    def __init__(self, name: str) -> None:
        self.published: list[Any] = []
        self.warned: list[str] = []
        self.subscribed: dict[str, str] = {}

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        assert topic == "objects"
        return SimpleNamespace(publish=self.published.append)

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=lambda text, **_: self.warned.append(text))


class Synchronizer:
    def __init__(self, subscribers: list[tuple[type, str]], queue_size: int, slop: float) -> None:
        assert [topic for _, topic in subscribers] == ["color", "depth", "camera_info"]

    def registerCallback(self, callback: Callable[..., None]) -> None:
        self.callback = callback


SENSOR_DATA = object()  # the QoS profile of sensors


def subscriber(node: Node, kind: type, name: str, qos_profile: object) -> tuple[type, str]:
    assert qos_profile is SENSOR_DATA
    node.subscribed[name] = kind.__name__
    return kind, name


@pytest.fixture
def node_class(monkeypatch: pytest.MonkeyPatch) -> type[Any]:
    def fake(name: str, **contents: object) -> None:
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)

    fake("rclpy", init=None, spin=None)
    fake("rclpy.node", Node=Node)
    fake("rclpy.qos", qos_profile_sensor_data=SENSOR_DATA)
    fake("message_filters", Subscriber=subscriber, ApproximateTimeSynchronizer=Synchronizer)
    for package, names in {
        "geometry_msgs": ("Point", "Vector3"),
        "sensor_msgs": ("CameraInfo", "CompressedImage", "Image"),
        "visualization_msgs": ("Marker", "MarkerArray"),
    }.items():
        fake(package)
        fake(f"{package}.msg", **{name: type(name, (Message,), {}) for name in names})
    spec = importlib.util.spec_from_file_location("ros2_node", CHECKOUT / "examples" / "ros2_node.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "ros2_node", module)
    spec.loader.exec_module(module)
    node: type[Any] = module.InstanceMapNode
    return node


def messages(k: int, encoding: str, in_meters: bool) -> tuple[Message, Message, Message]:
    frame = DESK[k]
    color = frame.color if encoding == "rgb8" else frame.color[..., ::-1]
    padded = np.pad(color.reshape(480, -1), ((0, 0), (0, 32)))  # rows may have padding
    depth = frame.depth if in_meters else np.rint(1000 * frame.depth).astype(np.uint16)
    if in_meters:
        depth = np.where(depth > 0, depth, np.nan).astype(np.float32)
    K = frame.camera.K.ravel().tolist()
    P = np.pad(frame.camera.K, ((0, 0), (0, 1))).ravel().tolist()
    image = Message(height=480, width=640, step=padded.shape[1], encoding=encoding, data=padded.tobytes())
    image.header.stamp = Message(sec=int(frame.timestamp), nanosec=int(1e9 * (frame.timestamp % 1)))
    kind = "32FC1" if in_meters else "16UC1"
    return (
        image,
        Message(height=480, width=640, step=640 * depth.itemsize, encoding=kind, is_bigendian=0, data=depth.tobytes()),
        SimpleNamespace(height=480, width=640, k=K, d=[0.0] * 5, p=P, distortion_model="plumb_bob"),
    )


@pytest.mark.parametrize(("encoding", "in_meters"), [("rgb8", False), ("bgr8", True)])
def test_ros2_node_maps_messages_and_publishes_objects(node_class: type[Any], encoding: str, in_meters: bool) -> None:
    node = node_class("fuser.voxel_size=0.02")
    for k in range(8):
        node.map(*messages(k, encoding, in_meters))
    assert node.warned == []
    found = node.mapper.instances()
    assert len(found) >= 2
    last = node.published[-1].markers
    assert last[0].action == Message.DELETEALL
    for marker in last[1:]:
        assert marker.text in node.mapper.classes
        assert 0 < marker.scale.x < 5
        assert marker.header.frame_id == "map"


def test_ros2_node_warns_about_lost_frame(node_class: type[Any]) -> None:
    node = node_class("fuser.voxel_size=0.02", "detector=none")
    color, depth, info = messages(0, "rgb8", False)
    depth.data = bytes(len(depth.data))
    node.map(color, depth, info)
    assert node.warned == ["pose lost: the frame has no depth"]
    assert node.published == []


COLOR = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
OPAQUE = np.full((24, 32, 1), 255, np.uint8)
GRAY = np.repeat(COLOR[..., :1], 3, axis=2)
MILLIMETERS = np.random.default_rng(1).integers(300, 5000, (24, 32), np.uint16)


def image(pixels: np.ndarray, encoding: str, big: int = 0) -> SimpleNamespace:
    """Return an image message with padded rows, as rclpy returns it."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, 4)))
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": padded.shape[1]}
    return SimpleNamespace(**size, encoding=encoding, is_bigendian=big, data=array("B", padded.tobytes()))


@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("rgb8", COLOR, COLOR),
        ("bgr8", COLOR[..., ::-1], COLOR),
        ("8UC3", COLOR[..., ::-1], COLOR),
        ("rgba8", np.dstack([COLOR, OPAQUE]), COLOR),
        ("bgra8", np.dstack([COLOR[..., ::-1], OPAQUE]), COLOR),
        ("8UC4", np.dstack([COLOR[..., ::-1], OPAQUE]), COLOR),
        ("mono8", COLOR[..., 0], GRAY),
        ("8UC1", COLOR[..., 0], GRAY),
    ],
)
def test_ros2_node_decodes_color(
    node_class: type[Any], encoding: str, stored: np.ndarray, expected: np.ndarray
) -> None:
    np.testing.assert_array_equal(sys.modules["ros2_node"].rgb(image(stored, encoding)), expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_ros2_node_decodes_bayer(node_class: type[Any], pattern: str) -> None:
    """A uniform color has the same value in all pixels of a channel."""
    mosaic = np.zeros((24, 32), np.uint8)
    for k, channel in enumerate(pattern):
        mosaic[k // 2 :: 2, k % 2 :: 2] = {"r": 200, "g": 120, "b": 40}[channel]
    decoded = sys.modules["ros2_node"].rgb(image(mosaic, f"bayer_{pattern}8"))
    np.testing.assert_array_equal(decoded[2:-2, 2:-2], np.broadcast_to([200, 120, 40], (20, 28, 3)))


@pytest.mark.parametrize(
    ("encoding", "stored", "big"),
    [
        ("16UC1", MILLIMETERS, 0),
        ("16UC1", MILLIMETERS.astype(">u2"), 1),
        ("mono16", MILLIMETERS, 0),
        ("32FC1", (MILLIMETERS / 1000).astype("<f4"), 0),
        ("32FC1", (MILLIMETERS / 1000).astype(">f4"), 1),
    ],
)
def test_ros2_node_decodes_depth(node_class: type[Any], encoding: str, stored: np.ndarray, big: int) -> None:
    depth = sys.modules["ros2_node"].meters(image(stored, encoding, big))
    np.testing.assert_allclose(depth, MILLIMETERS / 1000, atol=1e-6)


@pytest.mark.parametrize(("encoding", "kind"), [("rgb16", "16UC1"), ("rgb8", "8UC1")])
def test_ros2_node_unsupported_encoding_warns(node_class: type[Any], encoding: str, kind: str) -> None:
    node = node_class("detector=none")
    color, depth, info = messages(0, "rgb8", False)
    color.encoding, depth.encoding = encoding, kind
    node.map(color, depth, info)
    [warning] = node.warned
    assert re.search("expected one of the (color|depth) encodings", warning)


class Added(SimpleNamespace):
    """Mapper that stores the last frame."""

    def add(self, color: np.ndarray, depth: np.ndarray, **more: Any) -> SimpleNamespace:
        self.color, self.depth, self.camera = color, depth, more["camera"]
        return SimpleNamespace(lost=False, new=[], removed=[])


LENSES = {
    "plumb_bob": [0.3, -0.2, 0.001, -0.002, 0.05],
    "rational_polynomial": [0.3, -0.2, 0.001, -0.002, 0.05, 0.02, 0.01, -0.01],
    "equidistant": [0.02, -0.01, 0.003, -0.001],
}


@pytest.mark.parametrize("model", LENSES)
def test_ros2_node_undistorts_raw_images(node_class: type[Any], model: str) -> None:
    """A bright point of the recorded image moves to its pixel in the pinhole image."""
    node = node_class("detector=none")
    node.mapper = Added()
    color, depth, info = messages(0, "rgb8", False)
    info.d, info.distortion_model = LENSES[model], model
    K = np.reshape(info.k, (3, 3))
    ray = np.array([[[0.35, -0.3, 1.0]]])
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    recorded = project(ray, np.zeros(3), np.zeros(3), K, np.array(LENSES[model]))[0].ravel()
    u, v = np.rint(recorded).astype(int)
    pixels = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(pixels, (int(u), int(v)), 6, (255, 255, 255), -1)
    color.data, color.step = pixels.tobytes(), 1920
    node.map(color, depth, info)
    rows, columns = np.nonzero(node.mapper.color[..., 0] > 127)
    pinhole = (K @ ray.ravel())[:2]
    assert np.abs(pinhole - recorded).max() > 5
    np.testing.assert_allclose([columns.mean(), rows.mean()], pinhole, atol=1.5)


def test_ros2_node_rectified_images_use_projection_matrix(node_class: type[Any]) -> None:
    node = node_class("detector=none")
    node.mapper, node.rectified = Added(), True
    color, depth, info = messages(0, "rgb8", False)
    info.k, info.d = [600.0, 0, 330, 0, 600, 250, 0, 0, 1], [0.1, 0, 0, 0, 0]
    node.map(color, depth, info)
    assert node.mapper.camera == DESK[0].camera
    np.testing.assert_array_equal(node.mapper.color, DESK[0].color)


def compressed(data: bytes, named: str) -> Message:
    message = SimpleNamespace(format=named, data=array("B", data))
    message.header = Message(stamp=Message(sec=1, nanosec=0))
    return message


@pytest.mark.parametrize("color_format", [".png", ".jpg"])
@pytest.mark.parametrize("codec", ["compressedDepth png", "compressedDepth rvl", "png compressed "])
def test_ros2_node_maps_compressed_images(node_class: type[Any], color_format: str, codec: str) -> None:
    node = node_class("detector=none", compressed=True)
    assert node.subscribed == {"color": "CompressedImage", "depth": "CompressedImage", "camera_info": "CameraInfo"}
    node.mapper = Added()
    stored = np.rint(1000 * DESK[0].depth).astype(np.uint16)
    data = rvl(stored) if "rvl" in codec else cv2.imencode(".png", stored)[1].tobytes()
    color = cv2.imencode(color_format, DESK[0].color[..., ::-1])[1].tobytes()
    node.map(
        compressed(color, "bgr8; jpeg compressed bgr8"),
        compressed(bytes(12 * codec.startswith("compressedDepth")) + data, f"16UC1; {codec}"),
        messages(0, "rgb8", False)[2],
    )
    assert node.warned == []
    assert np.abs(node.mapper.color.astype(int) - DESK[0].color).mean() < 4
    np.testing.assert_allclose(node.mapper.depth, stored / 1000, atol=1e-6)


def test_ros2_node_subscribes_to_uncompressed_images(node_class: type[Any]) -> None:
    assert set(node_class("detector=none").subscribed.values()) == {"Image", "CameraInfo"}


@pytest.mark.parametrize(
    ("encoding", "conversion"),
    [("yuv422", cv2.COLOR_YUV2RGB_UYVY), ("yuv422_yuy2", cv2.COLOR_YUV2RGB_YUY2), ("yuyv", cv2.COLOR_YUV2RGB_YUY2)],
)
def test_ros2_node_decodes_yuv(node_class: type[Any], encoding: str, conversion: int) -> None:
    stored = np.full((24, 32, 2), 128, np.uint8)  # without color
    stored[..., 0 if conversion == cv2.COLOR_YUV2RGB_YUY2 else 1] = 90
    decoded = sys.modules["ros2_node"].rgb(image(stored, encoding))
    assert np.ptp(decoded) == 0
    assert decoded[0, 0, 0] == pytest.approx((90 - 16) * 255 / 219, abs=1)


@pytest.mark.parametrize("binning", [0, 1, 2, 4])
def test_ros2_node_binned_images_use_reduced_camera(node_class: type[Any], binning: int) -> None:
    node = node_class("detector=none")
    node.mapper = Added()
    color, depth, info = messages(0, "rgb8", False)
    full = DESK[0].camera.scaled(max(binning, 1))
    info.width, info.height, info.k = full.width, full.height, full.K.ravel()
    info.binning_x = info.binning_y = binning
    node.map(color, depth, info)
    assert node.warned == []
    assert vars(node.mapper.camera) == pytest.approx(vars(DESK[0].camera))
