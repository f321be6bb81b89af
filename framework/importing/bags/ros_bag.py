"""Import of ROS 1 and ROS 2 bags, including .bag files of RealSense's recorder.

    sensor_msgs/Image, CompressedImage      color (8 bits) and depth (16UC1 and similar: mm; 32FC1: m)
    sensor_msgs/CameraInfo                  intrinsics of color, and of depth if it is not registered: K and D of raw
                                            images, P of rectified images
    geometry_msgs/PoseStamped, PoseWithCovarianceStamped, nav_msgs/Path
                                            camera poses in optical axes, optional; a path is used on request only
    nav_msgs/Odometry, geometry_msgs/TransformStamped
                                            poses of the camera or of a frame that /tf_static connects with it, optional
    tf2_msgs/TFMessage                      transforms between the frames of color, depth, poses and accelerometer; the
                                            poses on /tf are used if the bag has no other poses
    sensor_msgs/Imu                         up direction, optional, from the accelerometer
    /device_0/sensor_1/Color_0/image/data   RealSense's color; Depth_0 contains depth. .../tf/0 is T_stream_depth, with
                                            the rotation as in the recorder's player. .../option/Depth Units is the
                                            depth unit in m. Depth is registered to color on import

Color and depth images are associated by time. Poses are interpolated at the time of the color image. The kind of the
depth sensor is derived from the topic names.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from framework.data import Camera
from framework.datasets.frames.conventions import LONGEST_COLOR_DELAY
from framework.datasets.tum_rgbd import Trajectory, associate
from framework.errors import DataError, FrameError
from framework.importing.bags.accelerometer import Accelerometer, find_accelerometer
from framework.importing.bags.camera_poses import MAX_POSE_INTERVAL, CameraPoses, find_camera_poses, pose_lines
from framework.importing.bags.depth_camera import BagDepth, find_depth_camera
from framework.importing.bags.ros_camera import RosLens, is_rectified, ros_camera
from framework.importing.bags.ros_images import decode_ros_color
from framework.importing.bags.ros_messages import Message, RosBag
from framework.importing.bags.ros_topics import BagOptions, Topics, found_topics
from framework.importing.bags.transform_tree import TransformTree
from framework.importing.source import DeviceFrame, Format, Source, StoredFrame, StoredOdometry
from framework.sensors.noise_models import kind_of_device

MAX_PAIR_INTERVAL = 0.02  # s, maximum time between a color image and its depth image at 25 Hz and faster
MAX_WAITING = 64  # maximum number of unpaired images

log = logging.getLogger(__name__)


def recognized(path: Path) -> bool:
    """Return True if the path is a ROS bag."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") if path.is_file() else (path / "metadata.yaml").is_file()


def open_source(path: Path, given: Topics, options: BagOptions) -> Source:
    """Open a bag.

    Args:
        path: The bag.
        given: The topics set by the user.
        options: The options set by the user.

    Raises:
        DataError: The bag cannot be read, or data are missing.
        ConfigError: A topic does not exist or has the wrong type, or several topics are possible.
    """
    bag = RosBag(path)
    tree = TransformTree(bag)
    topics = found_topics(bag, given, tree)
    info = bag.first(topics.camera_info)
    if info is None:
        raise DataError(f"{path}: {topics.camera_info}: expected at least one message, got none")
    camera, lens = ros_camera(f"{path}: {topics.camera_info}", info, is_rectified(topics.color))
    depth_camera = find_depth_camera(bag, topics, tree, options, camera, lens)
    # camera.json has one lens for both images; resampled depth is of the pinhole camera
    stored = None if lens is None or depth_camera.registration is not None else lens.distortion
    if stored:
        depth_camera = replace(depth_camera, lens=None)
    pairs = _pairs(bag, topics, options.max_difference)
    accelerometer = find_accelerometer(bag, tree, topics.color, [pair.timestamp for pair in pairs])
    poses = find_camera_poses(bag, topics, tree, options, [pair.timestamp for pair in pairs])
    device = Device(bag, topics, camera, None if stored else lens, depth_camera, accelerometer, poses)
    source = poses.source if poses else "none"
    return Source(
        f"a ROS bag (color {topics.color}, depth {topics.depth}, poses {source})",
        _frames(device, pairs),
        len(pairs),
        posed=poses is not None,
        distortion=stored,
        sensor=kind_of_device(f"{topics.depth} {topics.color}"),
        odometry=_odometry(bag, topics, tree) if topics.odometry else None,
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
    lens: RosLens | None  # of color, corrected on import; None = pinhole camera, or corrected on reading
    depth_camera: BagDepth
    accelerometer: Accelerometer | None
    poses: CameraPoses | None  # None = no poses

    def frame(self, pair: Pair, color: Message, depth: Message) -> DeviceFrame:
        """Decode two messages and return the frame.

        Raises:
            DataError: An image or the pose is invalid.
        """
        where = f"{self.bag.path}, {pair.timestamp:.6f} s"
        image = decode_ros_color(f"{where}: {color.topic}", self.bag.decoded(color))
        return DeviceFrame(
            name=where,
            timestamp=pair.timestamp,
            depth_timestamp=pair.depth_timestamp,
            camera=self.camera,
            color=image if self.lens is None else self.lens.smooth(image),
            depth=self.depth_camera.depth(where, depth),
            T_world_camera=self.poses.at(pair.timestamp) if self.poses else None,
            up=self.accelerometer.up(pair.timestamp) if self.accelerometer else None,
        )


def _pairs(bag: RosBag, topics: Topics, max_difference: float) -> list[Pair]:
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
    limit = max_difference or _pair_interval(sensed.values())
    by_header, by_record = (_associated(times[topics.color], times[topics.depth], limit) for times in (sensed, stored))
    pairs = by_header if by_header and 2 * len(by_header) >= len(by_record) else by_record
    colors, depths = len(sensed[topics.color]), len(sensed[topics.depth])
    if not pairs:
        raise DataError(
            f"{bag.path}: expected color and depth images within {limit:g} s of each other, got none among {colors} "
            f"images on {topics.color} and {depths} on {topics.depth}; set --max-difference to a larger time in s, or "
            "--color and --depth to topics of one camera"
        )
    largest = max(abs(pair.timestamp - pair.depth_timestamp) for pair in pairs)
    if largest > MAX_PAIR_INTERVAL:
        text = "%s: color and depth images are up to %.3g s apart; --max-difference S sets another limit"
        log.warning(text, bag.path, largest)
    if len(pairs) < max(colors, depths):
        log.warning(
            "%s: skipped %d of %d color images and %d of %d depth images without a partner within %.3g s; "
            "--max-difference S sets another limit",
            bag.path,
            colors - len(pairs),
            colors,
            depths - len(pairs),
            depths,
            limit,
        )
    return pairs


def _pair_interval(times: Iterable[Sequence[float]]) -> float:
    """Return the maximum time between a color image and its depth image, s: half the interval of the faster camera."""
    steps = [np.diff(np.unique(of_topic)) for of_topic in times if len(set(of_topic)) > 1]
    usual = min((float(np.median(of_topic)) for of_topic in steps), default=0.0)
    return min(max(MAX_PAIR_INTERVAL, usual / 2), LONGEST_COLOR_DELAY)


def _associated(color_times: Sequence[float], depth_times: Sequence[float], limit: float) -> list[Pair]:
    """Associate color and depth images whose times, s, differ by at most `limit`."""
    # Only the first image of each time is used, because some recorders write zero for all times. The indices are sorted
    # to restore the recording order.
    colors, depths = (sorted(np.unique(times, return_index=True)[1].tolist()) for times in (color_times, depth_times))
    pairs = associate([color_times[i] for i in colors], [depth_times[j] for j in depths], limit)
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


def _odometry(bag: RosBag, topics: Topics, tree: TransformTree) -> StoredOdometry:
    """Return the odometry as camera poses, or as poses of its frame if the bag does not contain the camera.

    Raises DataError for a topic without messages, or with an invalid pose.
    """
    lines, base = pose_lines(bag, topics.odometry)
    trajectory = Trajectory.of(bag.path, lines, MAX_POSE_INTERVAL)
    camera = tree.frame_of(topics.color)
    T_base_camera = np.eye(4) if base is None or base == camera else tree.fixed(to=base, of=camera)
    if T_base_camera is None:
        name = base or "the unnamed moving frame"
        expected = f"expected the transform from {name} to {camera} in /tf_static, got none"
        log.warning("%s: %s; set dataset.odometry_camera to the pose of the camera", topics.odometry, expected)
    poses = [line.pose() if T_base_camera is None else line.pose() @ T_base_camera for line in trajectory.lines]
    return StoredOdometry(trajectory.timestamps, poses, of_camera=T_base_camera is not None)


NEEDS = "a ROS 1 or ROS 2 bag, or a RealSense recording: .bag, .mcap, .db3 or a folder with metadata.yaml"
FORMAT = Format("ros_bag", NEEDS, recognized, open_source, has_topics=True)
