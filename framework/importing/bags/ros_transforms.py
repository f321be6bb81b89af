"""Transforms between sensors in a ROS bag."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.errors import DataError
from framework.geometry import inverse
from framework.importing.bags.ros_messages import TRANSFORMS, RosBag

REALSENSE = "/device_"  # prefix of topics of RealSense's recorder
SMALLEST_QUATERNION = 0.5  # minimum norm of a valid quaternion


def stream_motion(bag: RosBag, stream: str) -> Float64 | None:
    """Return the transform (4, 4) from the reference frame to a RealSense stream, or None if unknown.

    A stream is for example /device_0/sensor_1/Color_0. All streams have the same reference frame.

    Raises:
        DataError: The rotation is invalid.
    """
    stored = bag.first(f"{stream}/tf/0") if stream.startswith(REALSENSE) else None
    if stored is None:
        return None
    R_stream_reference = _rotation(stored.rotation)
    if R_stream_reference is None:
        found = " ".join(f"{getattr(stored.rotation, name):g}" for name in "xyzw")
        raise DataError(
            f"{bag.path}: {stream}: expected a quaternion x y z w of length >= {SMALLEST_QUATERNION:g}, got {found}"
        )
    T_stream_reference = np.eye(4)
    T_stream_reference[:3, :3] = R_stream_reference
    T_stream_reference[:3, 3] = [getattr(stored.translation, name) for name in "xyz"]
    return T_stream_reference


def static_motion(bag: RosBag, to: str, of: str) -> Float64 | None:
    """Return the transform T_to_of (4, 4) between two frames from /tf_static, or None if unknown.

    Args:
        bag: The bag.
        to: The name of the target frame.
        of: The name of the source frame.
    """
    neighbors: dict[str, dict[str, Float64]] = defaultdict(dict)
    for message in bag.messages([topic for topic in bag.topics(TRANSFORMS) if topic.endswith("tf_static")]):
        for stored in bag.decoded(message).transforms:
            parent, child = stored.header.frame_id.lstrip("/"), stored.child_frame_id.lstrip("/")
            T_parent_child = _motion(stored.transform)
            if T_parent_child is not None:
                neighbors[parent][child], neighbors[child][parent] = T_parent_child, inverse(T_parent_child)
    start = to.lstrip("/")
    T_to: dict[str, Float64] = {start: np.eye(4)}  # pose of each reached frame
    waiting = [start]
    while waiting:
        reached = waiting.pop()
        for name, T_reached_name in neighbors[reached].items():
            if name not in T_to:
                T_to[name] = T_to[reached] @ T_reached_name
                waiting.append(name)
    return T_to.get(of.lstrip("/"))


def _motion(stored: Any) -> Float64 | None:
    """Return the rigid transform (4, 4) of a Transform message, or None if it is invalid."""
    R = _rotation(stored.rotation)
    translation = [getattr(stored.translation, name) for name in "xyz"]
    if R is None or not np.isfinite(translation).all():
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, translation
    return T


def _rotation(quaternion: Any) -> Float64 | None:
    """Return the rotation matrix (3, 3) of a quaternion message, or None if it is invalid."""
    quat_xyzw = [getattr(quaternion, name) for name in "xyzw"]
    if not np.isfinite(quat_xyzw).all() or np.linalg.norm(quat_xyzw) < SMALLEST_QUATERNION:
        return None
    return np.asarray(Rotation.from_quat(quat_xyzw).as_matrix())
