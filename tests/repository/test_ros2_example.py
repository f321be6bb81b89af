"""Tests for the ROS 2 node in examples/, with fake ROS modules."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from framework.datasets.tum_rgbd import TumRgbd

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


@pytest.fixture
def node_class(monkeypatch: pytest.MonkeyPatch) -> type[Any]:
    def fake(name: str, **contents: object) -> None:
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)

    fake("rclpy", init=None, spin=None)
    fake("rclpy.node", Node=Node)
    fake("message_filters", Subscriber=lambda _, kind, name: (kind, name), ApproximateTimeSynchronizer=Synchronizer)
    for package, names in {
        "geometry_msgs": ("Point", "Vector3"),
        "sensor_msgs": ("CameraInfo", "Image"),
        "visualization_msgs": ("Marker", "MarkerArray"),
    }.items():
        fake(package)
        fake(f"{package}.msg", **dict.fromkeys(names, Message))
    spec = importlib.util.spec_from_file_location("ros2_node", CHECKOUT / "examples" / "ros2_node.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
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
    image = Message(height=480, width=640, step=padded.shape[1], encoding=encoding, data=padded.tobytes())
    image.header.stamp = Message(sec=int(frame.timestamp), nanosec=int(1e9 * (frame.timestamp % 1)))
    kind = "32FC1" if in_meters else "16UC1"
    return (
        image,
        Message(height=480, width=640, step=640 * depth.itemsize, encoding=kind, data=depth.tobytes()),
        Message(height=480, width=640, k=K),
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
