"""Selection of the topics of a ROS bag by type and name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import PurePosixPath
from posixpath import commonpath

from framework.config.validation import require
from framework.data import Float64
from framework.errors import ConfigError, DataError
from framework.files.number_lines import numbers
from framework.files.tum_trajectory import rigid_pose
from framework.importing.bags.ros_camera import TRANSPORTS
from framework.importing.bags.ros_images import shows_depth
from framework.importing.bags.ros_messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    PATH,
    POSE,
    POSE_WITH_COVARIANCE,
    TRANSFORM,
    TRANSFORMS,
    RosBag,
)
from framework.importing.bags.transform_tree import REALSENSE, TransformTree

COLOR = re.compile("color|rgb", re.IGNORECASE)
DEPTH = re.compile("depth", re.IGNORECASE)
NEITHER = re.compile("infra|(^|/|_)ir(/|_|$)|disparity|confidence|mask|label|fisheye|theora|points", re.IGNORECASE)
REGISTERED = re.compile("(?<!un)(aligned|registered)|to_color|to_rgb", re.IGNORECASE)  # depth in the color camera
OPTIONS = {
    "color": "--color",
    "depth": "--depth",
    "camera_info": "--camera-info",
    "poses": "--poses",
    "odometry": "--odometry",
}
TRANSPORT = ("/compressed", "/compressedDepth")  # ends of the topics of supported transports, preferred last
NO_POSES = "none"  # value of --poses: import without poses
IMAGES, POSES = (IMAGE, COMPRESSED), (ODOMETRY, POSE)
OTHER_POSES = (TRANSFORM, POSE_WITH_COVARIANCE, PATH)  # often sparse or of other objects; selected without POSES only
COMMANDED = re.compile("goal|initial_?pose|setpoint|waypoint|target|cmd|command|desired", re.IGNORECASE)
KINDS = {
    "color": IMAGES,
    "depth": IMAGES,
    "camera_info": (CAMERA_INFO,),
    "poses": (*POSES, *OTHER_POSES, *TRANSFORMS),
    "odometry": (*POSES, *OTHER_POSES),
}


@dataclass(frozen=True)
class Topics:
    """Topics of color, depth, camera and poses.

    An empty topic is selected by type and name.
    """

    color: str = ""
    depth: str = ""
    camera_info: str = ""  # of color
    poses: str = ""  # optional; "none" = no poses
    odometry: str = ""  # optional; never selected by type; "" = no odometry

    @property
    def given(self) -> list[str]:
        """Command-line options of the topics that are set."""
        return [option for name, option in OPTIONS.items() if getattr(self, name) not in ("", NO_POSES)]

    @property
    def depth_is_registered(self) -> bool:
        """True if the name of the depth topic indicates that depth is registered to color."""
        return bool(REGISTERED.search(self.depth))


@dataclass(frozen=True)
class BagOptions:
    """Facts about a bag that are not recorded in it."""

    max_difference: float = 0.0  # s, maximum time between a color image and its depth image; 0 = from the frame rate
    depth_unit: float = 0.0  # m, unit of the depth images; 0 = as recorded, else 0.001 for integers and 1 for floats
    depth_registered: bool = False  # True = depth is registered to color although the bag does not show it
    camera_pose: str = ""  # T_base_camera, "tx ty tz qx qy qz qw", m, of the frame of the poses; "" = from /tf_static

    def __post_init__(self) -> None:
        require(0 <= self.max_difference <= 1, "--max-difference", self.max_difference, "a value in [0, 1] s")
        unit = self.depth_unit
        require(unit == 0 or 1e-6 <= unit <= 1, "--depth-unit", unit, "a value in [1e-6, 1] m")
        self.T_base_camera()

    @property
    def given(self) -> list[str]:
        """Command-line options that are set."""
        return [f"--{field.name.replace('_', '-')}" for field in fields(self) if getattr(self, field.name)]

    def T_base_camera(self) -> Float64 | None:
        """Return the pose (4, 4) of the camera in the frame of the poses, or None if it is not set."""
        if not self.camera_pose:
            return None
        values = numbers("--camera-pose", self.camera_pose.split(), 7, "tx ty tz qx qy qz qw")
        return rigid_pose("--camera-pose", values[:3], values[3:])


def found_topics(bag: RosBag, given: Topics, tree: TransformTree) -> Topics:
    """Select the topics that are not set by the user.

    Raises:
        ConfigError: A topic does not exist or has the wrong type, or no single topic matches.
        DataError: The bag has no matching camera info.
    """
    images = [topic for topic in bag.topics(*IMAGES) if not NEITHER.search(topic)]
    depths = [topic for topic in images if DEPTH.search(topic) and _shows_depth(bag, topic) is not False]
    depths = depths or [topic for topic in images if _shows_depth(bag, topic)]
    depth = given.depth or _one(bag, "depth", depths, REGISTERED)
    colors = [topic for topic in images if topic not in (*depths, depth)]
    colors = [topic for topic in colors if not DEPTH.search(topic)] or colors
    color = given.color or _one(bag, "color", colors, COLOR)
    info = given.camera_info or camera_info_of(bag, color)
    is_of_depth = info and _is_of_depth(bag, tree, info, color, depth)
    if not given.camera_info and info and (is_of_depth or not is_of_camera(bag, tree, info, color)):
        expected = f"expected a {CAMERA_INFO} topic of {color}"
        found = f"got only {info}, which belongs to {depth if is_of_depth else tree.frame_of(info)}"
        raise DataError(f"{bag.path}: {expected}, {found}; set --camera-info {info} if both have the same intrinsics")
    if not info:
        expected = f"expected a {CAMERA_INFO} topic next to {color}"
        raise DataError(f"{bag.path}: {expected}, got none{_choice(bag, 'camera_info')}")
    of_camera = () if bag.topics(*TRANSFORMS) else (POSE_WITH_COVARIANCE,)  # poses of robots are of a base frame
    posed = pose_topics(bag, given, *POSES) or pose_topics(bag, given, TRANSFORM, *of_camera)
    if len(posed) > 1 and not given.poses:
        raise ConfigError(
            f"{bag.path}: expected one topic with poses, got {', '.join(posed)}; set --poses to one of them or to none"
        )
    topics = replace(given, color=color, depth=depth, camera_info=info, poses=given.poses or "".join(posed))
    for name, kinds in KINDS.items():
        topic = getattr(topics, name)
        if topic and (name, topic) != ("poses", NO_POSES) and bag.kinds.get(topic) not in kinds:
            found = f"{topic} of type {bag.kinds[topic]}" if topic in bag.kinds else f"unknown topic {topic}"
            expected = f"{OPTIONS[name]}: expected a topic of type {' or '.join(kinds)}"
            raise ConfigError(f"{expected}, got {found}{_choice(bag, name)}")
    return topics


def camera_info_of(bag: RosBag, image: str) -> str:
    """Return the CameraInfo topic of an image topic, or "" if the bag has no such topic."""
    shared = {topic: _shared_parts(topic, image) for topic in bag.topics(CAMERA_INFO)}
    if len(shared) == 1:
        return next(iter(shared))
    best = max(shared.values(), default=1)  # 1 = only the root is shared
    return min((topic for topic, count in shared.items() if count == best), key=len) if best > 1 else ""


def pose_topics(bag: RosBag, topics: Topics, *kinds: str) -> list[str]:
    """Return the topics of some types that may have poses of the camera, which excludes goals and the odometry."""
    return [topic for topic in bag.topics(*kinds) if topic != topics.odometry and not COMMANDED.search(topic)]


def _shows_depth(bag: RosBag, topic: str) -> bool | None:
    """Return `shows_depth` of the first message of a topic; None also for a damaged message."""
    try:
        message = bag.first(topic)
        return None if message is None else shows_depth(message)
    except DataError:
        return None


def is_of_camera(bag: RosBag, tree: TransformTree, info: str, image: str) -> bool:
    """Return False if a CameraInfo outside of the namespace of an image has the frame of another camera."""
    parts = [part for part in image.split("/") if part not in TRANSPORTS]
    if info.split("/")[:-1] in (parts, parts[:-1]) or image.startswith(REALSENSE):
        return True
    frames = {tree.frame_of(topic) for topic in (info, image)} - {""}
    return len(frames) < 2


def _shared_parts(topic: str, other: str) -> int:
    """Return the number of leading path components that two topics share, with the root."""
    folders = [f"/{name.strip('/').rpartition('/')[0]}" for name in (topic, other)]
    return len(PurePosixPath(commonpath(folders)).parts)


def _is_of_depth(bag: RosBag, tree: TransformTree, info: str, color: str, depth: str) -> bool:
    """Return True if a CameraInfo belongs to unregistered depth images, and not to the color images."""
    if REGISTERED.search(depth) or _shared_parts(info, depth) <= _shared_parts(info, color):
        return False
    frame = tree.frame_of(color)
    return not frame or tree.frame_of(info) != frame


def _one(bag: RosBag, name: str, candidates: Sequence[str], preferred: re.Pattern[str]) -> str:
    """Return the only topic among the candidates, after filtering by preferred names and uncompressed images."""
    fitting = [topic for topic in candidates if preferred.search(topic)] or list(candidates)
    left = [topic for topic in fitting if bag.kinds[topic] == IMAGE] or fitting
    transports = [topic.rpartition("/") for topic in left]
    if len({base for base, _, _ in transports}) == 1:  # several transports of one image
        left = [topic for topic in left if topic.endswith(TRANSPORT)][-1:] or left
    if len(left) == 1:
        return left[0]
    expected = f"expected one {name} topic, got {', '.join(left) or 'none'}"
    raise ConfigError(f"{bag.path}: {expected}{_choice(bag, name)}")


def _choice(bag: RosBag, name: str) -> str:
    """Return the end of an error message, with the possible topics of an option."""
    existing = bag.topics(*KINDS[name])
    return f"; set {OPTIONS[name]} to one of these topics: {', '.join(existing)}" if existing else ""
