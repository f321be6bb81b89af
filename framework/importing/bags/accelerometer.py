"""Which way is up by the accelerometer of a ROS bag (sensor_msgs/Imu), where the bag says how it stands to the camera.

At rest an accelerometer measures what holds it against gravity: a vector up, of 9.8 m/s^2 (REP 145). It is in the axes
of the message's frame. An image's header names the optical axes of its camera, by the definition of sensor_msgs/Image;
/tf_static has the rotation between the two. RealSense's recorder keeps it beside each stream.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64
from framework.errors import DataError, FrameError
from framework.importing.bags.ros_messages import IMU, NANOSECONDS, RosBag
from framework.importing.bags.ros_transforms import REALSENSE, static_rotation, stream_motion

NEAR = 0.05  # s, from a frame: what was measured in this time is averaged, so that a hand's trembling is not
GRAVITY = 9.81  # m/s^2
OFF = 0.2  # of that, that the median may be longer or shorter: a biased sensor, not one whose gravity was taken out
GYROSCOPE = re.compile("gyro", re.IGNORECASE)  # in names of topics that have no acceleration

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Accelerometer:
    """What was measured, in the axes of the colour camera."""

    times: Float64  # (N,) s, in order
    measured: Float64  # (N, 3) m/s^2

    def up(self, timestamp: float) -> Float64 | None:
        """The unit vector (3,) up in the camera at that time, s; None where nothing was measured near it."""
        first, end = np.searchsorted(self.times, (timestamp - NEAR, timestamp + NEAR))
        if first == end:
            return None
        mean = self.measured[first:end].mean(axis=0)
        length = float(np.linalg.norm(mean))
        return mean / length if length > 0 else None


def find_accelerometer(bag: RosBag, color: str, timestamps: Sequence[float]) -> Accelerometer | None:
    """That of a bag whose colour images have this topic and these times, s; None where none tells, with a warning why.

    Of several the first one by name that can be used is taken.
    """
    topics = [topic for topic in bag.topics(IMU) if not GYROSCOPE.search(topic)]
    reasons = []
    for topic in topics:
        found = _accelerometer(bag, topic, color)
        if isinstance(found, str):
            reasons.append(found)
        elif all(found.up(timestamp) is None for timestamp in timestamps):
            reasons.append(f"{topic} measured nothing within {NEAR:g} s of a frame")
        else:
            return found
    if reasons:
        log.warning("%s: no accelerometer tells which way is up: %s", bag.path, "; ".join(reasons))
    return None


def _accelerometer(bag: RosBag, topic: str, color: str) -> Accelerometer | str:
    """The accelerometer of a topic, or why it tells nothing."""
    times, measured, frame_id = _read(bag, topic)
    if not len(times):
        return f"{topic} has no message that can be read"
    length = float(np.median(np.linalg.norm(measured, axis=1)))
    if abs(length - GRAVITY) > OFF * GRAVITY:
        return f"{topic} measures {length:.3g} m/s^2, not gravity"
    R_camera_imu = _rotation(bag, topic, frame_id, color)
    if R_camera_imu is None:
        return f"how {topic} stands to the camera of {color} is not in the bag"
    order = np.argsort(times, kind="stable")
    return Accelerometer(times[order], measured[order] @ R_camera_imu.T)


def _rotation(bag: RosBag, topic: str, frame_id: str, color: str) -> Float64 | None:
    """R_camera_imu (3, 3)"""
    try:
        if topic.startswith(REALSENSE):
            T_imu_reference = stream_motion(bag, topic.removesuffix("/imu/data"))
            T_color_reference = stream_motion(bag, color.removesuffix("/image/data"))
            if T_imu_reference is None or T_color_reference is None:
                return None
            return np.asarray(T_color_reference[:3, :3] @ T_imu_reference[:3, :3].T)
        image = bag.first(color)
        return None if image is None else static_rotation(bag, image.header.frame_id, frame_id)
    except DataError as error:
        log.warning("%s", error)
        return None


def _read(bag: RosBag, topic: str) -> tuple[Float64, Float64, str]:
    """Times (N,) s by the headers, what was measured (N, 3) m/s^2, and in which frame; damaged messages left out."""
    times, measured, frame_id, damaged = [], [], "", 0
    try:
        for message in bag.messages([topic]):
            try:
                said, time = bag.decoded(message), bag.sensed_at(message) * NANOSECONDS
            except FrameError:
                damaged += 1
                continue
            vector = [getattr(said.linear_acceleration, name) for name in "xyz"]
            if np.isfinite(vector).all():
                times.append(time)
                measured.append(vector)
                frame_id = frame_id or said.header.frame_id
    except DataError as error:
        log.warning("%s; what comes before is used", error)
    if damaged:
        log.warning("%s: %d messages of %s are damaged and left out", bag.path, damaged, topic)
    return np.array(times), np.array(measured, np.float64).reshape(-1, 3), frame_id
