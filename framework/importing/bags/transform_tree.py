"""Tree of the coordinate frames in a ROS bag.

One tree contains the transforms of /tf_static, /tf and RealSense's recorder. Depth, poses and gravity use it:

    /tf_static                      transforms between rigidly mounted frames
    /tf                             transforms with time; those that never change count as rigid
    /device_0/sensor_1/Color_0/tf/0     RealSense's recorder: transform from a common reference frame to the stream
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.errors import DataError, FrameError
from framework.geometry import interpolate, inverse, rotation_angle
from framework.importing.bags.ros_messages import TRANSFORMS, RosBag

REALSENSE = "/device_"  # prefix of topics of RealSense's recorder
STATIC = "tf_static"  # end of the names of topics with transforms between rigidly mounted frames
SMALLEST_QUATERNION = 0.5  # minimum norm of a valid quaternion
SAME_POSITION, SAME_ANGLE = 1e-3, 2e-3  # m, radians; maximum difference between equal transforms
LONGEST_INTERVAL = 0.1  # s, maximum time to the nearest transform of a moving frame
FIXED_FRAME = re.compile("(^|[/_])(map|odom|world|earth)([/_]|$)")  # names of world frames (REP 105)

log = logging.getLogger(__name__)

_STREAM = re.compile(rf"({REALSENSE}.+)/tf/0")
_DATA = re.compile("/(image|imu)/data(/|$)")


def stream_of(topic: str) -> str:
    """Return the stream of a topic of RealSense's recorder, such as /device_0/sensor_1/Color_0."""
    return _DATA.split(topic)[0]


def is_fixed_frame(name: str) -> bool:
    """Return True for names of world frames, such as `map`, `robot/odom` and `camera_odom_frame`."""
    return bool(FIXED_FRAME.search(name))


@dataclass(frozen=True)
class Edge:
    """The transforms from a child frame to its parent frame."""

    parent: str
    child: str
    times: Float64  # (N,) s, increasing
    T_parent_child: Float64  # (N, 4, 4)
    is_static: bool  # True if a transform is from /tf_static
    error: str = ""  # reason why the transforms are unusable; "" = usable

    @cached_property
    def is_fixed(self) -> bool:
        """True if the frames do not move relative to each other. A single transform of /tf does not show this."""
        return self.is_static or (len(self.times) > 1 and _are_equal(self.T_parent_child))

    def at(self, timestamp: float) -> Float64 | None:
        """Return T_parent_child (4, 4) at a time in s, or None if unknown.

        Raises:
            DataError: The transforms are invalid or contradict each other.
        """
        if self.error:
            raise DataError(self.error)
        if self.is_fixed:
            return np.asarray(self.T_parent_child[0])
        after = int(np.searchsorted(self.times, timestamp, side="right"))
        around = slice(max(after - 1, 0), after + 1)
        times, poses = self.times[around], self.T_parent_child[around]
        is_enclosed = len(times) == 2 and times[0] <= timestamp
        # slow publishers repeat a constant transform, such as the correction of the odometry
        if np.abs(times - timestamp).min() > LONGEST_INTERVAL and not (is_enclosed and _are_equal(poses)):
            return None
        if not is_enclosed:
            return np.asarray(poses[np.abs(times - timestamp).argmin()])
        return interpolate(poses[0], poses[1], (timestamp - times[0]) / (times[1] - times[0]))


@dataclass(frozen=True)
class FrameChain:
    """The transforms between two frames."""

    steps: Sequence[tuple[Edge, bool]]  # edges from the target frame to the source frame; True = from parent to child

    @property
    def frames(self) -> set[str]:
        """Names of the frames."""
        return {name for edge, _ in self.steps for name in (edge.parent, edge.child)}

    @property
    def is_fixed(self) -> bool:
        """True if the frames do not move relative to each other."""
        return all(edge.is_fixed for edge, _ in self.steps)

    def at(self, timestamp: float = 0.0) -> Float64 | None:
        """Return the transform (4, 4) from the source to the target frame at a time in s, or None if unknown.

        Raises:
            DataError: A transform is invalid or contradicts others.
        """
        T_target_source = np.eye(4)
        for edge, is_down in self.steps:
            T_parent_child = edge.at(timestamp)
            if T_parent_child is None:
                return None
            T_target_source = T_target_source @ (T_parent_child if is_down else inverse(T_parent_child))
        return T_target_source


class TransformTree:
    """The coordinate frames in a bag."""

    def __init__(self, bag: RosBag) -> None:
        """Create the tree; the transforms are read on demand."""
        self.bag = bag

    def frame_of(self, topic: str) -> str:
        """Return the frame of the messages on a topic, or "" if unknown."""
        if topic.startswith(REALSENSE):
            return stream_of(topic)
        message = self.bag.first(topic)
        return "" if message is None else _name(message.header.frame_id)

    def fixed(self, to: str, of: str) -> Float64 | None:
        """Return the transform T_to_of (4, 4) between two rigidly mounted frames, or None if it is not in the bag.

        Raises:
            DataError: A transform is invalid or contradicts others, or the frames move relative to each other.
        """
        chain = self.chain(to, of)
        if chain is None:
            return None
        moving = next((edge for edge, _ in chain.steps if not edge.is_fixed and not edge.error), None)
        if moving is not None:
            raise DataError(
                f"{self.bag.path}: expected a rigid transform from {of} to {to}, got a moving joint from "
                f"{moving.parent} to {moving.child}"
            )
        return chain.at()

    def chain(self, to: str, of: str) -> FrameChain | None:
        """Return the transforms from one frame to another, or None if they are not in the bag.

        Rigid transforms are preferred.

        Raises:
            DataError: Several paths of rigid transforms contradict each other.
        """
        start, end = _name(to), _name(of)
        if not start or not end:
            return None
        fixed = [edge for edge in self._edges if edge.is_fixed]
        return self._search(start, end, fixed) or self._search(start, end, self._edges)

    def world_of(self, frame: str) -> str:
        """Return the topmost ancestor of a frame, or "" if no transform between them changes with time.

        Raises:
            DataError: An ancestor has two parents.
        """
        moves = False
        seen = [_name(frame)]
        while parents := [edge for edge in self._edges if edge.child == seen[-1]]:
            if len(parents) > 1:
                found = " and ".join(sorted(edge.parent for edge in parents))
                raise DataError(f"{self.bag.path}: {seen[-1]}: expected one parent frame on /tf, got {found}")
            if parents[0].parent in seen:
                raise DataError(f"{self.bag.path}: {seen[-1]}: expected a tree of frames on /tf, got a cycle")
            moves |= not parents[0].is_fixed
            seen.append(parents[0].parent)
        return seen[-1] if moves else ""

    @cached_property
    def moves(self) -> bool:
        """True if some frames move relative to each other."""
        return any(not edge.is_fixed and not edge.error for edge in self._edges)

    def _search(self, start: str, end: str, edges: Sequence[Edge]) -> FrameChain | None:
        neighbors: dict[str, list[tuple[str, Edge, bool]]] = defaultdict(list)
        for edge in edges:
            neighbors[edge.parent].append((edge.child, edge, True))
            neighbors[edge.child].append((edge.parent, edge, False))
        chains = {start: FrameChain(())}
        others: dict[str, FrameChain] = {}  # second path to a frame
        waiting = [start]
        while waiting:
            reached = waiting.pop(0)
            for name, edge, is_down in neighbors[reached]:
                chain = FrameChain((*chains[reached].steps, (edge, is_down)))
                if name not in chains:
                    chains[name] = chain
                    waiting.append(name)
                elif name not in chains[reached].frames:
                    others[name] = chain
        found = chains.get(end)
        for name in found.frames & others.keys() if found else ():
            self._check_equal(start, name, chains[name], others[name])
        return found

    def _check_equal(self, start: str, end: str, chain: FrameChain, other: FrameChain) -> None:
        """Raise DataError if two paths of rigid transforms contradict each other."""
        transforms = [T for one in (chain, other) if one.is_fixed and (T := one.at()) is not None]
        if len(transforms) == 2 and not _are_equal(np.array(transforms)):
            raise DataError(
                f"{self.bag.path}: expected one transform from {end} to {start}, got two paths that contradict each "
                "other; record one source of transforms"
            )

    @cached_property
    def _edges(self) -> list[Edge]:
        stored: dict[tuple[str, str], list[tuple[float, Float64 | None, bool]]] = defaultdict(list)
        for parent, child, timestamp, T_parent_child, is_static in self._stored():
            stored[parent, child].append((timestamp, T_parent_child, is_static))
        return [self._edge(parent, child, samples) for (parent, child), samples in stored.items()]

    def _edge(self, parent: str, child: str, samples: Sequence[tuple[float, Float64 | None, bool]]) -> Edge:
        valid = {timestamp: T for timestamp, T, _ in samples if T is not None}
        times = np.array(sorted(valid))
        transforms = np.array([valid[time] for time in times]).reshape(-1, 4, 4)
        is_static = any(static for _, _, static in samples)
        where, error = f"{self.bag.path}: {parent} to {child}", ""
        if not len(times):
            expected = f"expected a finite transform with a quaternion x y z w of length >= {SMALLEST_QUATERNION:g}"
            error = f"{where}: {expected}, got {len(samples)} invalid"
        elif is_static and not _are_equal(np.array([T for _, T, _ in samples if T is not None])):
            error = f"{where}: expected one transform on /tf_static, got several that contradict each other"
        return Edge(parent, child, times, transforms, is_static, error)

    def _stored(self) -> Iterator[tuple[str, str, float, Float64 | None, bool]]:
        """Yield parent, child, time (s) and transform of each stored transform, and True for those of /tf_static."""
        for topic in self.bag.kinds:
            if match := _STREAM.fullmatch(topic):
                T_stream_reference = _motion(self.bag.first(topic))
                T_reference_stream = None if T_stream_reference is None else inverse(T_stream_reference)
                yield REALSENSE, match[1], 0.0, T_reference_stream, True
        try:
            for message in self.bag.messages(self.bag.topics(*TRANSFORMS)):
                try:
                    content = self.bag.decoded(message)
                except FrameError as error:
                    log.warning("%s; message skipped", error)
                    continue
                for one in content.transforms:
                    stamp = one.header.stamp
                    names = _name(one.header.frame_id), _name(one.child_frame_id)
                    is_static = message.topic.endswith(STATIC)
                    yield *names, stamp.sec + 1e-9 * stamp.nanosec, _motion(one.transform), is_static
        except DataError as error:
            log.warning("%s; using the transforms before the error", error)


def _name(frame_id: str) -> str:
    return frame_id.lstrip("/") if not frame_id.startswith(REALSENSE) else frame_id


def _are_equal(transforms: Float64) -> bool:
    """Return True if rigid transforms (N, 4, 4) are equal up to rounding."""
    if np.abs(transforms[:, :3, 3] - transforms[0, :3, 3]).max() > SAME_POSITION:
        return False
    return all(rotation_angle(transforms[0, :3, :3].T @ T[:3, :3]) <= SAME_ANGLE for T in transforms)


def _motion(stored: Any) -> Float64 | None:
    """Return the rigid transform (4, 4) of a Transform message, or None if it is invalid."""
    quat_xyzw = [getattr(stored.rotation, name) for name in "xyzw"]
    translation = [getattr(stored.translation, name) for name in "xyz"]
    if not np.isfinite([*quat_xyzw, *translation]).all() or np.linalg.norm(quat_xyzw) < SMALLEST_QUATERNION:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quat_xyzw).as_matrix(), translation
    return T
