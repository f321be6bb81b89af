"""ROS bags of a small room, written by rosbags."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from framework.data import Camera, Float64
from framework.geometry import inverse
from tests.support.recordings.phone_exports import ROOM, T_COLOR_DEPTH
from tests.support.scenes.corner_room import look, pose_at

START = 1_600_000_000  # s
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
COUNT = 4
DEPTH_LATE = 0.004  # time from each color image to its depth image, s


@dataclass
class BagWriter:
    """Collection of messages that can be written as a ROS 1 or ROS 2 bag."""

    ros1: bool = False
    messages: list[tuple[float, str, str, Any]] = field(default_factory=list)  # (time in s, topic, type, message)

    def __post_init__(self) -> None:
        self.types = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:  # the type stores of all distributions lack tf2_msgs
            self.types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_MESSAGE))

    def made(self, name: str, **fields: Any) -> Any:
        return self.types.types[name](**fields)

    def header(self, time: float, frame_id: str = "camera_color_optical_frame") -> Any:
        nanoseconds = round(time * 1e9)
        stamp = self.made("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        sequence = {"seq": 0} if self.ros1 else {}
        return self.made("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **sequence)

    def add(self, time: float, topic: str, kind: str, **fields: Any) -> None:
        self.messages.append((time, topic, kind, self.made(kind, **fields)))

    def add_image(
        self,
        time: float,
        topic: str,
        image: np.ndarray,
        encoding: str,
        padding: int = 0,
        stamp: float | None = None,
        frame_id: str = "camera_color_optical_frame",
    ) -> None:
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(len(image), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        self.add(
            time,
            topic,
            "sensor_msgs/msg/Image",
            header=self.header(time if stamp is None else stamp, frame_id),
            height=image.shape[0],
            width=image.shape[1],
            encoding=encoding,
            is_bigendian=int(image.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def add_compressed(self, time: float, topic: str, data: bytes, named: str) -> None:
        packed = np.frombuffer(data, np.uint8)
        self.add(time, topic, "sensor_msgs/msg/CompressedImage", header=self.header(time), format=named, data=packed)

    def add_camera(
        self,
        time: float,
        topic: str,
        camera: Camera,
        model: str = "plumb_bob",
        lens: Sequence[float] = (0,) * 5,
        rectified: Camera | None = None,
        R: Float64 | None = None,
        binning: int = 0,
        region: tuple[int, int, int, int] = (0, 0, 0, 0),
        frame_id: str = "camera_color_optical_frame",
    ) -> None:
        """Add a CameraInfo of the full resolution; `region` = x offset, y offset, height and width."""
        matrices = {
            "d": np.array(lens, float),
            "k": camera.K.ravel(),
            "r": (np.eye(3) if R is None else R).ravel(),
            "p": np.pad((rectified or camera).K, ((0, 0), (0, 1))).ravel(),
        }
        roi = dict(zip(("x_offset", "y_offset", "height", "width"), region, strict=True))
        self.add(
            time,
            topic,
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time, frame_id),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=self.made("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **roi),
            **{name.upper() if self.ros1 else name: matrix for name, matrix in matrices.items()},
        )

    def pose(self, T: Float64) -> Any:
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        return self.made(
            "geometry_msgs/msg/Pose",
            position=self.made("geometry_msgs/msg/Point", **dict(zip("xyz", T[:3, 3].tolist(), strict=True))),
            orientation=self.made("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True))),
        )

    def add_pose(self, time: float, topic: str, T: Float64) -> None:
        self.add(time, topic, "geometry_msgs/msg/PoseStamped", header=self.header(time, "map"), pose=self.pose(T))

    def add_pose_with_covariance(self, time: float, topic: str, T: Float64) -> None:
        pose = self.made("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=np.zeros(36))
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self.add(time, topic, kind, header=self.header(time, "map"), pose=pose)

    def add_transform_stamped(self, time: float, topic: str, T: Float64, child: str) -> None:
        kind = "geometry_msgs/msg/TransformStamped"
        self.add(time, topic, kind, **vars(self.transform_stamped(time, "world", child, T)))

    def add_path(self, time: float, topic: str, poses: Sequence[tuple[float, Float64]]) -> None:
        kind = "geometry_msgs/msg/PoseStamped"
        stamped = [self.made(kind, header=self.header(at, "map"), pose=self.pose(T)) for at, T in poses]
        self.add(time, topic, "nav_msgs/msg/Path", header=self.header(time, "map"), poses=stamped)

    def add_odometry(self, time: float, topic: str, T: Float64, child: str) -> None:
        zero = dict.fromkeys("xyz", 0.0)
        still = {name: self.made("geometry_msgs/msg/Vector3", **zero) for name in ("linear", "angular")}
        twist = self.made("geometry_msgs/msg/Twist", **still)
        unknown = np.zeros(36)
        self.add(
            time,
            topic,
            "nav_msgs/msg/Odometry",
            header=self.header(time, "odom"),
            child_frame_id=child,
            pose=self.made("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=unknown),
            twist=self.made("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )

    def vector(self, values: Float64) -> Any:
        return self.made("geometry_msgs/msg/Vector3", **dict(zip("xyz", values.tolist(), strict=True)))

    def transform(self, T: Float64) -> dict[str, Any]:
        q = Rotation.from_matrix(T[:3, :3]).as_quat()
        rotation = self.made("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True)))
        return {"translation": self.vector(T[:3, 3]), "rotation": rotation}

    def transform_stamped(self, time: float, parent: str, child: str, T: Float64) -> Any:
        return self.made(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=self.made("geometry_msgs/msg/Transform", **self.transform(T)),
        )

    def add_transform(self, topic: str, T: Float64) -> None:
        self.add(START, topic, "geometry_msgs/msg/Transform", **self.transform(T))

    def add_static(self, *transforms: tuple[str, str, Float64]) -> None:
        """Add static transforms. Each is a tuple of parent, child and T_parent_child."""
        self.add_tf(START, *transforms, topic="/tf_static")

    def add_tf(self, time: float, *transforms: tuple[str, str, Float64], topic: str = "/tf") -> None:
        """Add transforms at one time. Each is a tuple of parent, child and T_parent_child."""
        stamped = [self.transform_stamped(time, *transform) for transform in transforms]
        self.add(time, topic, TF_MESSAGE, transforms=stamped)

    def add_imu(self, time: float, topic: str, acceleration: Float64, frame_id: str) -> None:
        unknown = np.zeros(9)
        self.add(
            time,
            topic,
            "sensor_msgs/msg/Imu",
            header=self.header(time, frame_id),
            orientation=self.made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=unknown,
            angular_velocity=self.vector(np.zeros(3)),
            angular_velocity_covariance=unknown,
            linear_acceleration=self.vector(acceleration),
            linear_acceleration_covariance=unknown,
        )

    def write(self, path: Path) -> Path:
        """Write a ROS 1 bag or a ROS 2 folder.

        The folder has an .mcap file if `path` contains "mcap", else a .db3 file.
        """
        if self.ros1:
            writer: Any = Writer1(path)
            serialize: Callable[..., Any] = self.types.serialize_ros1
        else:
            plugin = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
            serialize = self.types.serialize_cdr
        with writer:
            topics: dict[str, Any] = {}
            for time, topic, kind, message in sorted(self.messages, key=lambda entry: entry[0]):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.types)
                writer.write(topics[topic], round(time * 1e9), bytes(serialize(message, kind)))
        return path


def time_of(k: int) -> float:
    return round(START + k / 30, 6)


def seen(k: int, camera: Camera = ROOM) -> tuple[np.ndarray, np.ndarray]:
    """Return the color (H, W, 3) and the exact depth (H, W), m, of frame k."""
    depth, _, color, _ = look(camera, pose_at(k))
    return color, depth


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def compressed_depth(depth: np.ndarray, encode: Callable[[np.ndarray], bytes] = png) -> tuple[bytes, str]:
    """Return depth (m) in the inverse depth format of compressed_depth_image_transport, and the format name."""
    a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0  # for a quantization of 100 and a range of 10 m
    stored = np.where(depth > 0, np.rint(a / np.where(depth > 0, depth, 1) + b), 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + encode(stored), f"32FC1; compressedDepth {encode.__name__}"


def millimeters(depth: np.ndarray) -> np.ndarray:
    return np.rint(1000 * depth).astype(np.uint16)


def add_camera_of_ros(bag: BagWriter, depth: str = "aligned_depth_to_color") -> None:
    """Add the topics of realsense2_camera with align_depth."""
    for k in range(COUNT):
        color, metric = seen(k)
        bag.add_image(time_of(k), "/camera/color/image_raw", color, "rgb8", padding=16)
        bag.add_image(time_of(k) + DEPTH_LATE, f"/camera/{depth}/image_raw", millimeters(metric), "16UC1")
        bag.add_camera(time_of(k), "/camera/color/camera_info", ROOM)
        bag.add_camera(time_of(k), f"/camera/{depth}/camera_info", ROOM)


def add_realsense(bag: BagWriter, depth_camera: Camera, unit: float = 0.0001) -> None:
    """Add the topics of the RealSense recorder. Depth is in units of `unit` m and not registered to color."""
    color_topic, depth_topic = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    bag.add_camera(START, f"{color_topic}/info/camera_info", ROOM)
    bag.add_camera(START, f"{depth_topic}/info/camera_info", depth_camera, "Brown Conrady")
    bag.add_transform(f"{color_topic}/tf/0", T_COLOR_DEPTH)
    bag.add_transform(f"{depth_topic}/tf/0", np.eye(4))
    bag.add(START, "/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", data=unit)
    for k in range(COUNT):
        color, _ = seen(k)
        metric = look(depth_camera, pose_at(k) @ T_COLOR_DEPTH)[0]
        stored = np.where(metric < 65535 * unit, np.rint(metric / unit), 0).astype(np.uint16)
        bag.add_image(time_of(k), f"{color_topic}/image/data", color, "rgb8")
        bag.add_image(time_of(k) + DEPTH_LATE, f"{depth_topic}/image/data", stored, "mono16")


T_CAMERA_ROS = np.eye(4)  # from camera axes with x forward and z up
T_CAMERA_ROS[:3, :3] = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
assert np.allclose(inverse(T_CAMERA_ROS)[:3, :3] @ [0, 0, 1], [1, 0, 0])
