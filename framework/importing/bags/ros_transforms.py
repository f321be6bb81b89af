"""How the sensors of a ROS bag stand to each other, as far as it says so itself."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.errors import DataError
from framework.importing.bags.ros_messages import TRANSFORMS, RosBag

REALSENSE = "/device_"  # begins the topics of its own recorder
SMALLEST_QUATERNION = 0.5  # length of what is a rotation


def stream_motion(bag: RosBag, stream: str) -> Float64 | None:
    """T_stream_reference (4, 4) of a stream of a RealSense recording, such as /device_0/sensor_1/Color_0.

    None where the bag does not say it. Raises DataError where the rotation is none.
    """
    stored = bag.first(f"{stream}/tf/0") if stream.startswith(REALSENSE) else None
    if stored is None:
        return None
    R_stream_reference = _rotation(stored.rotation)
    if R_stream_reference is None:
        raise DataError(f"{bag.path}: the rotation of {stream} is none")
    T_stream_reference = np.eye(4)
    T_stream_reference[:3, :3] = R_stream_reference
    T_stream_reference[:3, 3] = [getattr(stored.translation, name) for name in "xyz"]
    return T_stream_reference


def static_rotation(bag: RosBag, to: str, of: str) -> Float64 | None:
    """R_to_of (3, 3) of two frames by what /tf_static says, over others between them; None where it does not."""
    neighbours: dict[str, dict[str, Float64]] = defaultdict(dict)
    for message in bag.messages([topic for topic in bag.topics(TRANSFORMS) if topic.endswith("tf_static")]):
        for stored in bag.decoded(message).transforms:
            parent, child = _name(stored.header.frame_id), _name(stored.child_frame_id)
            R_parent_child = _rotation(stored.transform.rotation)
            if R_parent_child is not None:
                neighbours[parent][child], neighbours[child][parent] = R_parent_child, R_parent_child.T
    R_to: dict[str, Float64] = {_name(to): np.eye(3)}  # of each frame that was reached
    waiting = [_name(to)]
    while waiting:
        reached = waiting.pop()
        for name, R_reached_name in neighbours[reached].items():
            if name not in R_to:
                R_to[name] = R_to[reached] @ R_reached_name
                waiting.append(name)
    return R_to.get(_name(of))


def _name(frame_id: str) -> str:
    return frame_id.lstrip("/")


def _rotation(quaternion: Any) -> Float64 | None:
    """(3, 3), None where the numbers are no rotation."""
    quat_xyzw = [getattr(quaternion, name) for name in "xyzw"]
    if not np.isfinite(quat_xyzw).all() or np.linalg.norm(quat_xyzw) < SMALLEST_QUATERNION:
        return None
    return np.asarray(Rotation.from_quat(quat_xyzw).as_matrix())
