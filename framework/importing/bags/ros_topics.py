"""Which topics of a ROS bag are colour, depth, their cameras and poses: as given, else by type and name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

from framework.errors import ConfigError, DataError
from framework.importing.bags.ros_messages import CAMERA_INFO, COMPRESSED, IMAGE, ODOMETRY, POSE, RosBag

COLOR = re.compile("color|rgb", re.IGNORECASE)
DEPTH = re.compile("depth", re.IGNORECASE)
NEITHER = re.compile("infra|(^|/|_)ir(/|_|$)|disparity|confidence|mask|label|fisheye|theora|points", re.IGNORECASE)
REGISTERED = re.compile("aligned|registered|to_color|to_rgb", re.IGNORECASE)  # depth in colour's camera
OPTIONS = {"color": "--color", "depth": "--depth", "camera_info": "--camera-info", "poses": "--poses"}


@dataclass(frozen=True)
class Topics:
    """The names of topics; "" = to be found."""

    color: str = ""
    depth: str = ""
    camera_info: str = ""  # of colour
    poses: str = ""  # "" where there is none, too: poses are optional

    @property
    def given(self) -> list[str]:
        """The options of those that are named."""
        return [option for name, option in OPTIONS.items() if getattr(self, name)]

    @property
    def depth_is_registered(self) -> bool:
        """Whether the name of the depth says so."""
        return bool(REGISTERED.search(self.depth))


def found_topics(bag: RosBag, given: Topics) -> Topics:
    """All topics, found where they are not given. Raises DataError or ConfigError, with the option, where none fits."""
    images = [topic for topic in bag.topics(IMAGE, COMPRESSED) if not NEITHER.search(topic)]
    depth = given.depth or _one(bag, "depth", [topic for topic in images if DEPTH.search(topic)], REGISTERED)
    color = given.color or _one(bag, "color", [topic for topic in images if not DEPTH.search(topic)], COLOR)
    info = given.camera_info or camera_info_of(bag, color)
    if not info:
        raise DataError(f"{bag.path} has no {CAMERA_INFO} beside {color}; name one with --camera-info")
    posed = bag.topics(ODOMETRY, POSE)
    poses = given.poses or (posed[0] if len(posed) == 1 else "")
    if len(posed) > 1 and not given.poses:
        raise ConfigError(f"{bag.path} has several topics with poses: {', '.join(posed)}; choose one with --poses")
    topics = replace(given, color=color, depth=depth, camera_info=info, poses=poses)
    for name, kinds in (
        ("color", (IMAGE, COMPRESSED)),
        ("depth", (IMAGE, COMPRESSED)),
        ("camera_info", (CAMERA_INFO,)),
        ("poses", (ODOMETRY, POSE)),
    ):
        _check(bag, OPTIONS[name], getattr(topics, name), kinds)
    return topics


def camera_info_of(bag: RosBag, image: str) -> str:
    """The only CameraInfo, or that which stands nearest to a topic of images in the tree of names; "" = none does."""
    shared = {topic: _shared(topic, image) for topic in bag.topics(CAMERA_INFO)}
    if len(shared) == 1:
        return next(iter(shared))
    best = max(shared.values(), default=0)
    return min((topic for topic, count in shared.items() if count == best), key=len) if best else ""


def _shared(topic: str, other: str) -> int:
    """How many folders two names have in common, from the left."""
    pairs = zip(topic.strip("/").split("/")[:-1], other.strip("/").split("/")[:-1], strict=False)
    return len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))


def _one(bag: RosBag, name: str, candidates: Sequence[str], preferred: re.Pattern[str]) -> str:
    """The one topic that fits, uncompressed if there are both."""
    fitting = [topic for topic in candidates if preferred.search(topic)] or list(candidates)
    raw = [topic for topic in fitting if bag.kinds[topic] == IMAGE]
    left = raw or fitting
    if len(left) == 1:
        return left[0]
    said = f"several topics may be its {name}: {', '.join(left)}" if left else f"no topic can be its {name}"
    there = ", ".join(bag.topics(IMAGE, COMPRESSED)) or "none"
    raise ConfigError(f"{bag.path}: {said}; choose one with {OPTIONS[name]}. Its topics of images: {there}")


def _check(bag: RosBag, option: str, topic: str, kinds: Sequence[str]) -> None:
    if topic and bag.kinds.get(topic) not in kinds:
        found = bag.kinds.get(topic, "nothing of that name")
        there = ", ".join(bag.topics(*kinds)) or "none"
        raise ConfigError(f"{option} must be a topic of {' or '.join(kinds)}; {topic} is {found}. There are: {there}")
