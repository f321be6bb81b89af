"""Camera poses in a ROS bag, from a topic with poses or from /tf."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Float64
from framework.datasets.tum_rgbd import Trajectory
from framework.errors import DataError, FrameError
from framework.files.tum_trajectory import TumLine
from framework.importing.bags.ros_messages import (
    NANOSECONDS,
    ODOMETRY,
    PATH,
    POSE_WITH_COVARIANCE,
    TRANSFORM,
    TRANSFORMS,
    RosBag,
)
from framework.importing.bags.ros_topics import NO_POSES, BagOptions, Topics, pose_topics
from framework.importing.bags.transform_tree import TransformTree, is_fixed_frame
from framework.importing.source import warn_of_zeros

MAX_POSE_INTERVAL = 0.1  # s, maximum time between a color image and the nearest pose
# T_base_camera of a camera at the origin of a frame in ROS axes that looks along x
ROS_AXES = "0 0 0 -0.5 0.5 -0.5 0.5"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CameraPoses:
    """The poses of the color camera."""

    source: str  # topic and frames, for messages
    at: Callable[[float], Float64 | None]  # T_world_camera (4, 4) at a time in s; None = unknown


def find_camera_poses(
    bag: RosBag, topics: Topics, tree: TransformTree, options: BagOptions, timestamps: Sequence[float]
) -> CameraPoses | None:
    """Return the camera poses of the selected topic or of /tf, or None without poses.

    Args:
        bag: The bag.
        topics: The selected topics.
        tree: The coordinate frames of the bag.
        options: The options of the user.
        timestamps: The timestamps of the color images, s.

    Raises:
        DataError: The bag has poses of another frame without a transform to the camera, poses of other times only, or
            no valid pose.
    """
    if topics.poses == NO_POSES:
        return None
    camera = tree.frame_of(topics.color)
    if not topics.poses:
        found = _poses_on_tf(bag, tree, camera, "")
        unused = pose_topics(bag, topics, POSE_WITH_COVARIANCE, PATH)
        if found is None and unused:
            message = "%s: imported without poses; set --poses %s if this topic has the poses of the camera"
            log.warning(message, bag.path, unused[0])
        return found
    if bag.kinds[topics.poses] in TRANSFORMS:
        return _poses_on_tf(bag, tree, camera, topics.poses)
    lines, base = pose_lines(bag, topics.poses)
    trajectory = Trajectory.of(bag.path, lines, MAX_POSE_INTERVAL)
    if not len(trajectory.lines):
        warn_of_zeros(f"{bag.path}: {topics.poses}")
        return None
    _check_times(f"{bag.path}: {topics.poses}", trajectory.timestamps, timestamps)
    at_base = _mounting(bag, topics, tree, options, camera, base)

    def at(timestamp: float) -> Float64 | None:
        T_world_base, T_base_camera = trajectory.at(timestamp), at_base(timestamp)
        return None if T_world_base is None or T_base_camera is None else T_world_base @ T_base_camera

    return CameraPoses(topics.poses if base in (None, camera) else f"{topics.poses} of {base}", at)


def _mounting(
    bag: RosBag, topics: Topics, tree: TransformTree, options: BagOptions, camera: str, base: str | None
) -> Callable[[float], Float64 | None]:
    """Return the function of T_base_camera (4, 4) by time, s."""
    given = options.T_base_camera()
    if given is not None:
        return lambda _: given
    if base is None:  # PoseStamped does not name the moving frame
        level = logging.WARNING if bag.topics(*TRANSFORMS) else logging.INFO  # a robot may publish poses of its base
        message = "%s: %s: poses are used as poses of the camera in optical axes; --camera-pose sets another frame"
        log.log(level, message, bag.path, topics.poses)
        return lambda _: np.eye(4)
    if base == camera != "":
        return lambda _: np.eye(4)
    chain = tree.chain(to=base, of=camera) if base else None
    if chain is None:
        name = repr(base) if base else "the moving frame, which has no name,"
        raise DataError(
            f"{bag.path}: {topics.poses}: expected a transform from {name} to the camera {camera!r} on /tf_static, "
            f'got none; set --camera-pose "TX TY TZ QX QY QZ QW" (--camera-pose "{ROS_AXES}" if the moving frame is '
            "at the camera, with x forward and z up), or --poses none"
        )
    return chain.at


def _poses_on_tf(bag: RosBag, tree: TransformTree, camera: str, chosen: str) -> CameraPoses | None:
    """Return the poses of the camera in the topmost frame of /tf.

    The frame must have the name of a world frame if the user has not chosen the topic.
    """
    if not bag.topics(*TRANSFORMS):
        return None
    world = tree.world_of(camera)
    chain = tree.chain(to=world, of=camera) if world else None
    if chain is None:
        if chosen:
            raise DataError(
                f"{bag.path}: {chosen}: expected moving frames above the camera {camera!r}, got none; set --poses none"
            )
        if tree.moves:
            message = "%s: no frame of /tf moves the camera %r; imported without poses"
            log.warning(message, bag.path, camera)
        return None
    if not chosen and not is_fixed_frame(world):
        message = "%s: /tf contains the motion of the camera in the frame %r; set --poses /tf if this frame is fixed"
        log.warning(message, bag.path, world)
        return None
    return CameraPoses(f"/tf from {world} to {camera}", chain.at)


def _check_times(where: str, pose_times: Float64, timestamps: Sequence[float]) -> None:
    """Raise DataError if no pose belongs to the time of a color image."""
    first, last = float(pose_times[0]), float(pose_times[-1])
    if min(timestamps) <= last + MAX_POSE_INTERVAL and first - MAX_POSE_INTERVAL <= max(timestamps):
        return
    raise DataError(
        f"{where}: expected poses at the times of the color images ({min(timestamps):.3f} to {max(timestamps):.3f} s), "
        f"got poses from {first:.3f} to {last:.3f} s; set --poses none"
    )


def pose_lines(bag: RosBag, topic: str) -> tuple[list[TumLine], str | None]:
    """Return the poses of a topic and the name of their moving frame; "" = unnamed, None = not in the message type.

    Raises:
        DataError: The topic has no messages.
    """
    lines: list[TumLine] = []
    base = None
    for number, message in enumerate(bag.messages([topic]), start=1):
        try:
            content = bag.decoded(message)
        except FrameError as error:
            log.warning("%s; message skipped", error)
            continue
        if message.kind in (ODOMETRY, TRANSFORM):
            child, parent = content.child_frame_id.lstrip("/"), content.header.frame_id.lstrip("/")
            base = child if child != parent else ""  # some programs write the fixed frame twice
        if message.kind == PATH:  # the last message has all poses
            lines = [_line(bag, k, _time(pose), pose.pose) for k, pose in enumerate(content.poses, start=1)]
        else:
            lines.append(_line(bag, number, bag.sensed_at(message), content))
    if not lines:
        raise DataError(f"{bag.path}: {topic}: expected at least one pose, got none")
    return lines, base


def _time(message: Any) -> float:
    return float(message.header.stamp.sec + NANOSECONDS * message.header.stamp.nanosec)


def _line(bag: RosBag, number: int, timestamp: float, content: Any) -> TumLine:
    """Return the pose of a message."""
    while hasattr(content, "pose"):  # PoseWithCovarianceStamped.pose.pose
        content = content.pose
    if hasattr(content, "transform"):
        p, q = content.transform.translation, content.transform.rotation
    else:
        p, q = content.position, content.orientation
    return TumLine(bag.path, number, timestamp, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
