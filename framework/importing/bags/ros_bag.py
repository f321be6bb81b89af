"""ROS 1 and ROS 2 bags, and the .bag files of RealSense's own recorder, which are ROS 1 bags with topics of their own.

    sensor_msgs/Image, CompressedImage      colour (8 bits) and depth (16UC1 and alike: mm; 32FC1: m)
    sensor_msgs/CameraInfo                  intrinsics of colour, and of depth where it is not registered
    nav_msgs/Odometry, geometry_msgs/PoseStamped    poses of the camera, optional; in its optical axes where the name of
                                            the frame says so or there is none, else in ROS' (x forward)
    sensor_msgs/Imu, tf2_msgs/TFMessage     which way is up, optional: by the accelerometer and /tf_static
    /device_0/sensor_1/Color_0/image/data   RealSense's, likewise Depth_0; their .../tf/0 is T_stream_depth, with the
                                            rotation as the recorder's own player reads it, and .../option/Depth Units
                                            the metres of a unit. Depth is registered to colour here

Colour and depth belong together by time, as in TUM RGB-D; poses are interpolated to the time of colour.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float64
from framework.datasets.calibration.camera_json import pinhole
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.datasets.tum_rgbd import Trajectory, associate
from framework.errors import DataError, FrameError
from framework.files.tum_trajectory import TumLine
from framework.importing.bags.accelerometer import Accelerometer, find_accelerometer
from framework.importing.bags.ros_messages import NANOSECONDS, ODOMETRY, Message, RosBag, color_of, depth_of
from framework.importing.bags.ros_topics import Topics, camera_info_of, found_topics
from framework.importing.bags.ros_transforms import REALSENSE, stream_motion
from framework.importing.depth.depth_registration import DepthRegistration
from framework.importing.source import DeviceFrame, Source, StoredFrame

APART = 0.02  # s, at most, of a colour image and its depth
POSE_APART = 0.1  # s, at most, of a colour image and the nearest pose
MILLIMETRE = 0.001  # m
SAME_CAMERA = 0.01  # of the focal length and of the image's width: intrinsics that differ less are of one camera
MOST_WAITING = 64  # images whose partner has not come yet
BROWN = ("plumb_bob", "Brown Conrady", "")  # models of a lens with k1, k2, p1, p2, k3
DEPTH_STREAM = "/Depth_"  # in RealSense's names

log = logging.getLogger(__name__)


def recognised(path: Path) -> bool:
    """Whether `path` is a bag, by its name; a folder, by its metadata.yaml."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") if path.is_file() else (path / "metadata.yaml").is_file()


def open_source(path: Path, given: Topics) -> Source:
    """The recording in a bag. Raises DataError, naming it, when it is none that can be read; ConfigError for topics."""
    bag = RosBag(path)
    topics = found_topics(bag, given)
    info = bag.first(topics.camera_info)
    if info is None:
        raise DataError(f"{path}: {topics.camera_info} has no message")
    camera = _camera(f"{path}: {topics.camera_info}", info)
    pairs = _pairs(bag, topics)
    device = Device(
        bag,
        topics,
        camera,
        _registration(bag, topics, camera),
        _depth_unit(bag, topics),
        find_accelerometer(bag, topics.color, [pair.timestamp for pair in pairs]),
    )
    trajectory, axes = _trajectory(bag, topics.poses)
    frames = _frames(device, pairs, trajectory, PoseReading(camera_axes=axes))
    lens = _distortion(topics, info)
    name = f"a ROS bag (colour {topics.color}, depth {topics.depth}, poses {topics.poses or 'none'})"
    return Source(name, frames, len(pairs), posed=bool(topics.poses), distortion=lens)


@dataclass(frozen=True)
class Device:
    """What all frames of a bag share."""

    bag: RosBag
    topics: Topics
    camera: Camera  # of colour
    registration: DepthRegistration | None  # None: depth is colour's, perhaps in another size
    depth_unit: float  # m
    accelerometer: Accelerometer | None  # that tells which way is up

    def frame(self, color: Message, depth: Message, timestamp: float, pose: Float64 | None) -> DeviceFrame:
        """One frame from its messages. Raises DataError when they cannot be used."""
        where = f"{self.bag.path}, {timestamp:.6f} s"
        metric = depth_of(f"{where}: {depth.topic}", self.bag.decoded(depth), self.depth_unit)
        if self.registration is not None:
            if metric.shape != self.registration.depth.shape:
                raise FrameError(f"{where}: depth has {metric.shape}, its camera {self.registration.depth.shape} px")
            metric = self.registration.apply(metric)
        return DeviceFrame(
            name=where,
            timestamp=timestamp,
            camera=self.camera,
            color=color_of(f"{where}: {color.topic}", self.bag.decoded(color)),
            depth=metric,
            T_world_camera=pose,
            up=self.accelerometer.up(timestamp) if self.accelerometer else None,
        )


@dataclass(frozen=True)
class Pair:
    """A colour and a depth image that belong together, by their places among their topics' messages."""

    color: int
    depth: int
    timestamp: float  # s, of colour


def _pairs(bag: RosBag, topics: Topics) -> list[Pair]:
    """By the times of the headers; by those of recording where headers of the two are of different clocks."""
    sensed: dict[str, list[float]] = {topics.color: [], topics.depth: []}
    stored: dict[str, list[float]] = {topics.color: [], topics.depth: []}
    try:
        for message in bag.messages(list(sensed)):
            sensed[message.topic].append(bag.sensed_at(message) * NANOSECONDS)
            stored[message.topic].append(message.stored_at * NANOSECONDS)
    except DataError as error:
        log.warning("%s; what comes before is used", error)
    by_header, by_record = (_associated(times[topics.color], times[topics.depth]) for times in (sensed, stored))
    if by_header and 2 * len(by_header) >= len(by_record):
        return by_header
    if by_record:
        return by_record
    raise DataError(
        f"{bag.path}: none of {len(sensed[topics.color])} images of {topics.color} is within {APART:g} s of one of "
        f"{len(sensed[topics.depth])} of {topics.depth}"
    )


def _associated(of_color: list[float], of_depth: list[float]) -> list[Pair]:
    """Pairs by times (s) of two topics, of images with one time the first: some recorders leave all headers 0."""
    first_color, first_depth = _first_of_each(of_color), _first_of_each(of_depth)
    pairs = associate([of_color[i] for i in first_color], [of_depth[j] for j in first_depth], APART)
    return [Pair(first_color[i], first_depth[j], of_color[first_color[i]]) for i, j in pairs]


def _first_of_each(times: list[float]) -> list[int]:
    at: dict[float, int] = {}
    for k, time in enumerate(times):
        at.setdefault(time, k)
    return list(at.values())


def _frames(
    device: Device, pairs: list[Pair], trajectory: Trajectory | None, reading: PoseReading
) -> Iterator[StoredFrame]:
    """The frames as their second image comes along."""
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
            if pair not in waiting:
                if len(waiting) == MOST_WAITING:
                    yield partial(_raise, _alone(device, waiting.pop(next(iter(waiting)))))
                waiting[pair] = message
                continue
            other = waiting.pop(pair)
            color, depth = (message, other) if message.topic == topics.color else (other, message)
            yield partial(_read, device, pair, color, depth, trajectory, reading)
    except DataError as error:
        yield partial(_raise, error)
    for message in waiting.values():
        yield partial(_raise, _alone(device, message))


def _alone(device: Device, message: Message) -> DataError:
    place = f"{device.bag.path}, {message.stored_at * NANOSECONDS:.6f} s"
    return FrameError(f"{place}: the image of {message.topic} has lost its partner, which is far away or damaged")


def _read(
    device: Device, pair: Pair, color: Message, depth: Message, trajectory: Trajectory | None, reading: PoseReading
) -> DeviceFrame:
    stored = trajectory.at(pair.timestamp) if trajectory is not None else None
    return device.frame(color, depth, pair.timestamp, None if stored is None else reading.pose(stored))


def _raise(error: DataError) -> DeviceFrame:
    raise error


def _trajectory(bag: RosBag, topic: str) -> tuple[Trajectory | None, CameraAxes]:
    """The poses of a topic, and the axes of what they are of."""
    if not topic:
        return None, CameraAxes.OPENCV
    at: dict[float, TumLine] = {}
    frame_id = "optical"
    for number, message in enumerate(bag.messages([topic]), start=1):
        try:
            said = bag.decoded(message)
        except FrameError as error:
            log.warning("%s: left out", error)
            continue
        if message.kind == ODOMETRY:
            frame_id = said.child_frame_id
        pose = said.pose.pose if message.kind == ODOMETRY else said.pose
        p, q = pose.position, pose.orientation
        time = bag.sensed_at(message) * NANOSECONDS
        line = TumLine(bag.path, number, time, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        at.setdefault(time, line)
    if not at:
        raise DataError(f"{bag.path}: {topic} has no message")
    axes = CameraAxes.OPENCV if "optical" in frame_id else CameraAxes.ROS
    if axes is CameraAxes.ROS:
        log.warning("the poses of %s are of %r: taken as the camera's, with x forward and z up", topic, frame_id)
    lines = [at[time] for time in sorted(at)]
    return Trajectory(lines, np.array(sorted(at)), POSE_APART), axes


def _registration(bag: RosBag, topics: Topics, color: Camera) -> DepthRegistration | None:
    """How depth is moved into the colour camera. Raises DataError where it should be and nobody knows how."""
    own = camera_info_of(bag, topics.depth)
    if topics.depth_is_registered or not own or own == topics.camera_info:
        return None
    info = bag.first(own)
    if info is None:
        return None
    depth = _camera(f"{bag.path}: {own}", info)
    motion = _extrinsics(bag, topics)
    if motion is None:
        if _is_same(depth, color):
            return None
        raise DataError(
            f"{bag.path}: {topics.depth} is of another camera than {topics.color} ({own}), and how they stand to each "
            "other is not in the bag; record depth that is registered, such as aligned_depth_to_color"
        )
    return DepthRegistration(depth, color, motion)


def _is_same(depth: Camera, color: Camera) -> bool:
    scale = color.width / depth.width
    of_depth = np.array([depth.fx, depth.fy, depth.cx + 0.5, depth.cy + 0.5]) * scale
    of_color = np.array([color.fx, color.fy, color.cx + 0.5, color.cy + 0.5])
    return bool((np.abs(of_depth - of_color) <= SAME_CAMERA * color.width).all())


def _extrinsics(bag: RosBag, topics: Topics) -> Float64 | None:
    """T_color_depth (4, 4) of a RealSense recording, None of others."""
    T_color_reference, T_depth_reference = (
        stream_motion(bag, topic.removesuffix("/image/data")) for topic in (topics.color, topics.depth)
    )
    if T_color_reference is None or T_depth_reference is None:
        return None
    return np.asarray(T_color_reference @ np.linalg.inv(T_depth_reference))


def _depth_unit(bag: RosBag, topics: Topics) -> float:
    """m, of the whole numbers in depth images."""
    if not topics.depth.startswith(REALSENSE):
        return MILLIMETRE
    sensor = topics.depth.partition(DEPTH_STREAM)[0]
    for name in ("Depth Units", "Depth_Units"):
        said = bag.first(f"{sensor}/option/{name}/value")
        if said is not None and np.isfinite(said.data) and said.data > 0:
            return float(said.data)
    return MILLIMETRE


def _numbers(info: Any, name: str) -> list[float]:
    """A field of a CameraInfo, which ROS 1 writes with a capital."""
    return [float(value) for value in getattr(info, name.upper() if hasattr(info, name.upper()) else name)]


def _camera(where: str, info: Any) -> Camera:
    fx, _, cx, _, fy, cy, _, _, _ = _numbers(info, "k")
    return pinhole(where, info.width, info.height, fx, fy, cx, cy)


def _distortion(topics: Topics, info: Any) -> Distortion | None:
    """Of the lens of colour; None where there is none, or images are rectified."""
    values = _numbers(info, "d")
    if "rect" in topics.color.rpartition("/")[2] or not any(values):
        return None
    if info.distortion_model not in BROWN or len(values) > len(Distortion.__dataclass_fields__):
        log.warning("%s: a lens of the model %r is not undone", topics.camera_info, info.distortion_model)
        return None
    return Distortion(*values)
