"""Camera poses in a ROS bag, from a topic with poses or from /tf."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from framework.data import Float64
from framework.datasets.tum_rgbd import Trajectory
from framework.errors import DataError, FrameError
from framework.files.tum_trajectory import TumLine
from framework.importing.bags.ros_messages import ODOMETRY, TRANSFORMS, RosBag
from framework.importing.bags.ros_topics import NO_POSES, BagOptions, Topics
from framework.importing.bags.transform_tree import FIXED_FRAMES, TransformTree
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


def find_camera_poses(bag: RosBag, topics: Topics, tree: TransformTree, options: BagOptions) -> CameraPoses | None:
    """Return the camera poses of the selected topic or of /tf, or None without poses.

    Raises:
        DataError: The bag has poses of another frame without a transform to the camera, or no valid pose.
    """
    if topics.poses == NO_POSES:
        return None
    camera = tree.frame_of(topics.color)
    if not topics.poses:
        return _poses_on_tf(bag, tree, camera, "")
    if bag.kinds[topics.poses] in TRANSFORMS:
        return _poses_on_tf(bag, tree, camera, topics.poses)
    lines, base = pose_lines(bag, topics.poses)
    trajectory = Trajectory.of(bag.path, lines, MAX_POSE_INTERVAL)
    if not len(trajectory.lines):
        warn_of_zeros(f"{bag.path}: {topics.poses}")
        return None
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
    chain = tree.chain(to=base, of=camera)
    if chain is None:
        raise DataError(
            f"{bag.path}: {topics.poses}: expected a transform from {base!r} to the camera {camera!r} on /tf_static, "
            f'got none; set --camera-pose "TX TY TZ QX QY QZ QW" (--camera-pose "{ROS_AXES}" if {base!r} is at the '
            "camera, with x forward and z up), or --poses none"
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
    if not chosen and world.rpartition("/")[2] not in FIXED_FRAMES:
        message = "%s: /tf contains the motion of the camera in the frame %r; set --poses /tf if this frame is fixed"
        log.warning(message, bag.path, world)
        return None
    return CameraPoses(f"/tf from {world} to {camera}", chain.at)


def pose_lines(bag: RosBag, topic: str) -> tuple[list[TumLine], str | None]:
    """Return the poses of a topic and the name of their moving frame; None = unknown.

    Raises:
        DataError: The topic has no messages.
    """
    lines = []
    base = None
    for number, message in enumerate(bag.messages([topic]), start=1):
        try:
            content = bag.decoded(message)
        except FrameError as error:
            log.warning("%s; message skipped", error)
            continue
        if message.kind == ODOMETRY:
            base = content.child_frame_id.lstrip("/")
        pose = content.pose.pose if message.kind == ODOMETRY else content.pose
        p, q = pose.position, pose.orientation
        lines.append(TumLine(bag.path, number, bag.sensed_at(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))
    if not lines:
        raise DataError(f"{bag.path}: {topic}: expected at least one message, got none")
    return lines, base
