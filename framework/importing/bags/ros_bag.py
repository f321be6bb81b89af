"""Import of ROS 1 and ROS 2 bags, including .bag files of RealSense's recorder.

    sensor_msgs/Image, CompressedImage      color (8 bits) and depth (16UC1 and similar: mm; 32FC1: m)
    sensor_msgs/CameraInfo                  intrinsics of color, and of depth if it is not registered
    geometry_msgs/PoseStamped               camera poses in optical axes, optional
    nav_msgs/Odometry                       camera poses, optional; in optical axes if child_frame_id contains
                                            "optical", otherwise in ROS axes (x forward)
    sensor_msgs/Imu, tf2_msgs/TFMessage     up direction, optional, from the accelerometer and /tf_static
    /device_0/sensor_1/Color_0/image/data   RealSense's color; Depth_0 contains depth. .../tf/0 is T_stream_depth, with
                                            the rotation as in the recorder's player. .../option/Depth Units is the
                                            depth unit in m. Depth is registered to color on import

Color and depth images are associated by time. Poses are interpolated at the time of the color image. The kind of the
depth sensor is derived from the topic names.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera
from framework.datasets.calibration.camera_json import pinhole
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.datasets.tum_rgbd import Trajectory, associate
from framework.errors import DataError, FrameError
from framework.files.tum_trajectory import TumLine
from framework.importing.bags.accelerometer import Accelerometer, find_accelerometer
from framework.importing.bags.ros_messages import ODOMETRY, Message, RosBag, color_of, depth_of
from framework.importing.bags.ros_topics import Topics, camera_info_of, found_topics
from framework.importing.bags.ros_transforms import REALSENSE, static_motion, stream_motion
from framework.importing.depth_resampling import DepthRegistration
from framework.importing.source import DeviceFrame, Format, Source, StoredFrame, StoredOdometry
from framework.sensors.noise_models import kind_of_device

MAX_PAIR_INTERVAL = 0.02  # s, maximum time between a color image and its depth image
MAX_POSE_INTERVAL = 0.1  # s, maximum time between a color image and the nearest pose
MILLIMETER = 0.001  # m
SAME_CAMERA = 0.01  # fraction of the image width, maximum difference between intrinsics of the same camera
MAX_WAITING = 64  # maximum number of unpaired images
BROWN = ("plumb_bob", "Brown Conrady", "")  # names of the lens model with k1, k2, p1, p2, k3
DEPTH_STREAM = "/Depth_"  # in RealSense's topic names

log = logging.getLogger(__name__)


def recognized(path: Path) -> bool:
    """Return True if the path is a ROS bag."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") if path.is_file() else (path / "metadata.yaml").is_file()


def open_source(path: Path, given: Topics) -> Source:
    """Open a bag.

    Args:
        path: The bag.
        given: The topics set by the user.

    Raises:
        DataError: The bag cannot be read, or data are missing.
        ConfigError: A topic does not exist or has the wrong type, or several topics are possible.
    """
    bag = RosBag(path)
    topics = found_topics(bag, given)
    info = bag.first(topics.camera_info)
    if info is None:
        raise DataError(f"{path}: {topics.camera_info}: expected at least one message, got none")
    camera = _camera(f"{path}: {topics.camera_info}", info)
    pairs = _pairs(bag, topics)
    registration, unit = _registration(bag, topics, camera), _depth_unit(bag, topics)
    accelerometer = find_accelerometer(bag, topics.color, [pair.timestamp for pair in pairs])
    device = Device(bag, topics, camera, registration, unit, accelerometer, *_trajectory(bag, topics.poses))
    name = f"a ROS bag (color {topics.color}, depth {topics.depth}, poses {topics.poses or 'none'})"
    sensor = kind_of_device(f"{topics.depth} {topics.color}")
    return Source(
        name,
        _frames(device, pairs),
        len(pairs),
        posed=bool(topics.poses),
        distortion=_distortion(topics, info),
        sensor=sensor,
        odometry=_odometry(bag, topics) if topics.odometry else None,
    )


@dataclass(frozen=True)
class Pair:
    """A color image and a depth image taken at about the same time.

    The images are identified by the indices of their messages in the topics.
    """

    color: int
    depth: int
    timestamp: float  # s, of color
    depth_timestamp: float  # s


@dataclass(frozen=True)
class Device:
    """Calibration, topics and trajectory of a bag."""

    bag: RosBag
    topics: Topics
    camera: Camera  # of color
    registration: DepthRegistration | None  # None = depth is registered to color, possibly at another resolution
    depth_unit: float  # m
    accelerometer: Accelerometer | None
    trajectory: Trajectory | None
    pose_reading: PoseReading

    def frame(self, pair: Pair, color: Message, depth: Message) -> DeviceFrame:
        """Decode two messages and return the frame.

        Raises:
            DataError: An image or the pose is invalid.
        """
        where = f"{self.bag.path}, {pair.timestamp:.6f} s"
        stored = self.trajectory.at(pair.timestamp) if self.trajectory else None
        metric = depth_of(f"{where}: {depth.topic}", self.bag.decoded(depth), self.depth_unit)
        if self.registration is not None:
            if metric.shape != self.registration.depth.shape:
                sizes = [f"{width}x{height}" for height, width in (self.registration.depth.shape, metric.shape)]
                expected = f"expected depth of {sizes[0]} px as in its CameraInfo"
                raise FrameError(f"{where}: {expected}, got {sizes[1]} px")
            metric = self.registration.apply(metric)
        return DeviceFrame(
            name=where,
            timestamp=pair.timestamp,
            depth_timestamp=pair.depth_timestamp,
            camera=self.camera,
            color=color_of(f"{where}: {color.topic}", self.bag.decoded(color)),
            depth=metric,
            T_world_camera=None if stored is None else self.pose_reading.pose(stored),
            up=self.accelerometer.up(pair.timestamp) if self.accelerometer else None,
        )


def _pairs(bag: RosBag, topics: Topics) -> list[Pair]:
    """Associate color and depth images by time.

    Header timestamps are used, unless they give fewer than half as many pairs as the recording times.
    """
    sensed: dict[str, list[float]] = {topics.color: [], topics.depth: []}
    stored: dict[str, list[float]] = {topics.color: [], topics.depth: []}
    try:
        for message in bag.messages(list(sensed)):
            sensed[message.topic].append(bag.sensed_at(message))
            stored[message.topic].append(message.stored_at)
    except DataError as error:
        log.warning("%s; using the messages before the error", error)
    by_header, by_record = (_associated(times[topics.color], times[topics.depth]) for times in (sensed, stored))
    if by_header and 2 * len(by_header) >= len(by_record):
        return by_header
    if by_record:
        return by_record
    raise DataError(
        f"{bag.path}: expected color and depth images within {MAX_PAIR_INTERVAL:g} s of each other, got none among "
        f"{len(sensed[topics.color])} images on {topics.color} and {len(sensed[topics.depth])} on {topics.depth}; set "
        "--color and --depth to topics of one camera"
    )


def _associated(color_times: Sequence[float], depth_times: Sequence[float]) -> list[Pair]:
    """Associate color and depth images by their times, s."""
    # Only the first image of each time is used, because some recorders write zero for all times. The indices are sorted
    # to restore the recording order.
    colors, depths = (sorted(np.unique(times, return_index=True)[1].tolist()) for times in (color_times, depth_times))
    pairs = associate([color_times[i] for i in colors], [depth_times[j] for j in depths], MAX_PAIR_INTERVAL)
    return [Pair(colors[i], depths[j], color_times[colors[i]], depth_times[depths[j]]) for i, j in pairs]


def _frames(device: Device, pairs: Sequence[Pair]) -> Iterator[StoredFrame]:
    """Yield the frames of a bag."""
    topics = device.topics
    partner = {topics.color: {pair.color: pair for pair in pairs}, topics.depth: {pair.depth: pair for pair in pairs}}
    counts = {topics.color: 0, topics.depth: 0}
    waiting: dict[Pair, Message] = {}
    try:
        for message in device.bag.messages(list(counts)):
            pair = partner[message.topic].get(counts[message.topic])
            counts[message.topic] += 1
            if pair is None:
                continue
            if pair in waiting:
                other = waiting.pop(pair)
                color, depth = (message, other) if message.topic == topics.color else (other, message)
                yield partial(device.frame, pair, color, depth)
                continue
            if len(waiting) == MAX_WAITING:
                yield partial(_raise, _alone(device, waiting.pop(next(iter(waiting)))))
            waiting[pair] = message
    except DataError as error:
        yield partial(_raise, error)
    for message in waiting.values():
        yield partial(_raise, _alone(device, message))


def _alone(device: Device, message: Message) -> DataError:
    place = f"{device.bag.path}, {message.stored_at:.6f} s"
    return FrameError(f"{place}: expected color and depth, got only the image on {message.topic}")


def _raise(error: DataError) -> DeviceFrame:
    raise error


def _trajectory(bag: RosBag, topic: str) -> tuple[Trajectory | None, PoseReading]:
    """Return the poses of a topic, if any, and their convention."""
    if not topic:
        return None, PoseReading()
    lines, frame_id = _pose_lines(bag, topic)
    axes = CameraAxes.OPENCV if frame_id is None or "optical" in frame_id else CameraAxes.ROS
    if axes is CameraAxes.ROS:
        log.warning("%s: poses of frame %r are used as camera poses, with x forward and z up", topic, frame_id)
    return Trajectory.of(bag.path, lines, MAX_POSE_INTERVAL), PoseReading(camera_axes=axes)


def _odometry(bag: RosBag, topics: Topics) -> StoredOdometry:
    """Return the odometry as camera poses, or as poses of its frame if /tf_static does not contain the camera.

    Raises DataError for a topic without messages, or with an invalid pose.
    """
    lines, frame_id = _pose_lines(bag, topics.odometry)
    trajectory = Trajectory.of(bag.path, lines, MAX_POSE_INTERVAL)
    image = bag.first(topics.color)
    T_base_camera = np.eye(4) if frame_id is None else static_motion(bag, frame_id, image.header.frame_id)
    if T_base_camera is None:
        expected = f"expected the transform from {frame_id} to {image.header.frame_id} in /tf_static, got none"
        log.warning("%s: %s; set dataset.odometry_camera to the pose of the camera", topics.odometry, expected)
    poses = [line.pose() if T_base_camera is None else line.pose() @ T_base_camera for line in trajectory.lines]
    return StoredOdometry(trajectory.timestamps, poses, of_camera=T_base_camera is not None)


def _pose_lines(bag: RosBag, topic: str) -> tuple[list[TumLine], str | None]:
    """Return the poses of a topic and the name of their moving frame; None = unknown.

    Raises DataError if the topic has no messages.
    """
    lines = []
    frame_id = None
    for number, message in enumerate(bag.messages([topic]), start=1):
        try:
            content = bag.decoded(message)
        except FrameError as error:
            log.warning("%s; message skipped", error)
            continue
        if message.kind == ODOMETRY:
            frame_id = content.child_frame_id
        pose = content.pose.pose if message.kind == ODOMETRY else content.pose
        p, q = pose.position, pose.orientation
        lines.append(TumLine(bag.path, number, bag.sensed_at(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))
    if not lines:
        raise DataError(f"{bag.path}: {topic}: expected at least one message, got none")
    return lines, frame_id


def _registration(bag: RosBag, topics: Topics, color: Camera) -> DepthRegistration | None:
    """Return the registration of depth to color, or None if depth is registered or its camera is unknown."""
    own = camera_info_of(bag, topics.depth)
    if topics.depth_is_registered or not own or own == topics.camera_info:
        return None
    info = bag.first(own)
    if info is None:
        return None
    depth = _camera(f"{bag.path}: {own}", info)
    T_color_reference, T_depth_reference = (
        stream_motion(bag, topic.removesuffix("/image/data")) for topic in (topics.color, topics.depth)
    )
    if T_color_reference is not None and T_depth_reference is not None:
        return DepthRegistration(depth, color, T_color_reference @ np.linalg.inv(T_depth_reference))
    if _is_same(depth, color):
        return None
    raise DataError(
        f"{bag.path}: {topics.depth}: expected depth in the camera of {topics.color}, or extrinsics in the bag, got "
        f"the camera of {own} without extrinsics; record registered depth, such as aligned_depth_to_color"
    )


def _is_same(depth: Camera, color: Camera) -> bool:
    scale = color.width / depth.width
    of_depth = np.array([depth.fx, depth.fy, depth.cx + 0.5, depth.cy + 0.5]) * scale
    of_color = np.array([color.fx, color.fy, color.cx + 0.5, color.cy + 0.5])
    return bool((np.abs(of_depth - of_color) <= SAME_CAMERA * color.width).all())


def _depth_unit(bag: RosBag, topics: Topics) -> float:
    """Return the unit of integer depth images, m."""
    if topics.depth.startswith(REALSENSE):
        sensor = topics.depth.partition(DEPTH_STREAM)[0]
        for name in ("Depth Units", "Depth_Units"):
            unit = bag.first(f"{sensor}/option/{name}/value")
            if unit is not None and np.isfinite(unit.data) and unit.data > 0:
                return float(unit.data)
    return MILLIMETER


def _numbers(info: Any, name: str) -> list[float]:
    """Return the values of a CameraInfo field, which has an upper-case name in ROS 1."""
    return [float(value) for value in getattr(info, name.upper() if hasattr(info, name.upper()) else name)]


def _camera(where: str, info: Any) -> Camera:
    fx, _, cx, _, fy, cy, _, _, _ = _numbers(info, "k")
    return pinhole(where, info.width, info.height, fx, fy, cx, cy)


def _distortion(topics: Topics, info: Any) -> Distortion | None:
    """Return the lens distortion of color, or None for a pinhole camera or an unsupported model."""
    values = _numbers(info, "d")
    if "rect" in topics.color.rpartition("/")[2] or not any(values):
        return None
    if info.distortion_model not in BROWN or len(values) > len(Distortion.__dataclass_fields__):
        message = "%s: expected a Brown-Conrady lens model, got %r; images are not undistorted"
        log.warning(message, topics.camera_info, info.distortion_model)
        return None
    return Distortion(*values)


NEEDS = "a ROS 1 or ROS 2 bag, or a RealSense recording: .bag, .mcap, .db3 or a folder with metadata.yaml"
FORMAT = Format("ros_bag", NEEDS, recognized, open_source, has_topics=True)
