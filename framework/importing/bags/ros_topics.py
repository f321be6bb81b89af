"""Selection of the topics of a ROS bag by type and name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from posixpath import commonpath

from framework.errors import ConfigError, DataError
from framework.importing.bags.ros_messages import CAMERA_INFO, COMPRESSED, IMAGE, ODOMETRY, POSE, RosBag

COLOR = re.compile("color|rgb", re.IGNORECASE)
DEPTH = re.compile("depth", re.IGNORECASE)
NEITHER = re.compile("infra|(^|/|_)ir(/|_|$)|disparity|confidence|mask|label|fisheye|theora|points", re.IGNORECASE)
REGISTERED = re.compile("aligned|registered|to_color|to_rgb", re.IGNORECASE)  # depth in the color camera
OPTIONS = {
    "color": "--color",
    "depth": "--depth",
    "camera_info": "--camera-info",
    "poses": "--poses",
    "odometry": "--odometry",
}
IMAGES, POSES = (IMAGE, COMPRESSED), (ODOMETRY, POSE)
KINDS = {"color": IMAGES, "depth": IMAGES, "camera_info": (CAMERA_INFO,), "poses": POSES, "odometry": POSES}


@dataclass(frozen=True)
class Topics:
    """Topics of color, depth, camera and poses.

    An empty topic is selected by type and name.
    """

    color: str = ""
    depth: str = ""
    camera_info: str = ""  # of color
    poses: str = ""  # optional; "" after the selection = no poses
    odometry: str = ""  # optional; never selected by type; "" = no odometry

    @property
    def given(self) -> list[str]:
        """Command-line options of the topics that are set."""
        return [option for name, option in OPTIONS.items() if getattr(self, name)]

    @property
    def depth_is_registered(self) -> bool:
        """True if the name of the depth topic indicates that depth is registered to color."""
        return bool(REGISTERED.search(self.depth))


def found_topics(bag: RosBag, given: Topics) -> Topics:
    """Select the topics that are not set by the user.

    Raises:
        ConfigError: A topic does not exist or has the wrong type, or no single topic matches.
        DataError: The bag has no matching camera info.
    """
    images = [topic for topic in bag.topics(*IMAGES) if not NEITHER.search(topic)]
    depth = given.depth or _one(bag, "depth", [topic for topic in images if DEPTH.search(topic)], REGISTERED)
    color = given.color or _one(bag, "color", [topic for topic in images if not DEPTH.search(topic)], COLOR)
    info = given.camera_info or camera_info_of(bag, color)
    if not info:
        expected = f"expected a {CAMERA_INFO} topic next to {color}"
        raise DataError(f"{bag.path}: {expected}, got none{_choice(bag, 'camera_info')}")
    posed = [topic for topic in bag.topics(*POSES) if topic != given.odometry]
    if len(posed) > 1 and not given.poses:
        raise ConfigError(
            f"{bag.path}: expected one topic with poses, got {', '.join(posed)}; set --poses to one of them"
        )
    topics = replace(given, color=color, depth=depth, camera_info=info, poses=given.poses or "".join(posed))
    for name, kinds in KINDS.items():
        topic = getattr(topics, name)
        if topic and bag.kinds.get(topic) not in kinds:
            found = f"{topic} of type {bag.kinds[topic]}" if topic in bag.kinds else f"unknown topic {topic}"
            expected = f"{OPTIONS[name]}: expected a topic of type {' or '.join(kinds)}"
            raise ConfigError(f"{expected}, got {found}{_choice(bag, name)}")
    return topics


def camera_info_of(bag: RosBag, image: str) -> str:
    """Return the CameraInfo topic of an image topic, or "" if the bag has no such topic."""
    infos = bag.topics(CAMERA_INFO)
    folders = {topic: f"/{topic.strip('/').rpartition('/')[0]}" for topic in (image, *infos)}
    shared = {topic: len(PurePosixPath(commonpath([folders[topic], folders[image]])).parts) for topic in infos}
    if len(shared) == 1:
        return next(iter(shared))
    best = max(shared.values(), default=1)  # 1 = only the root is shared
    return min((topic for topic, count in shared.items() if count == best), key=len) if best > 1 else ""


def _one(bag: RosBag, name: str, candidates: Sequence[str], preferred: re.Pattern[str]) -> str:
    """Return the only topic among the candidates, after filtering by preferred names and uncompressed images."""
    fitting = [topic for topic in candidates if preferred.search(topic)] or list(candidates)
    left = [topic for topic in fitting if bag.kinds[topic] == IMAGE] or fitting
    if len(left) == 1:
        return left[0]
    expected = f"expected one {name} topic, got {', '.join(left) or 'none'}"
    raise ConfigError(f"{bag.path}: {expected}{_choice(bag, name)}")


def _choice(bag: RosBag, name: str) -> str:
    """Return the end of an error message, with the possible topics of an option."""
    existing = bag.topics(*KINDS[name])
    return f"; set {OPTIONS[name]} to one of these topics: {', '.join(existing)}" if existing else ""
