"""Up directions from the accelerometer in a ROS bag.

At rest, an accelerometer measures an upward vector of 9.8 m/s^2 (REP 145). Its rotation to the camera is taken from
the transform tree of the bag.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64
from framework.errors import DataError, FrameError
from framework.importing.bags.ros_messages import IMU, RosBag
from framework.importing.bags.transform_tree import REALSENSE, TransformTree

NEAR = 0.05  # s, averaging window before and after a frame, which reduces the effect of hand tremor
GRAVITY = 9.81  # m/s^2
MAX_DEVIATION = 0.2  # fraction of GRAVITY, maximum deviation of the median acceleration; rejects data without gravity
GYROSCOPE = re.compile("gyro", re.IGNORECASE)  # matches names of topics without acceleration

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Accelerometer:
    """Accelerometer measurements in the axes of the color camera."""

    times: Float64  # (N,) s, ascending
    measured: Float64  # (N, 3) m/s^2

    def up(self, timestamp: float) -> Float64 | None:
        """Return the unit up vector (3,) in the camera frame at a time in s, or None without measurements."""
        first, end = np.searchsorted(self.times, (timestamp - NEAR, timestamp + NEAR))
        if first == end:
            return None
        mean = self.measured[first:end].mean(axis=0)
        length = float(np.linalg.norm(mean))
        return mean / length if length > 0 else None


def find_accelerometer(
    bag: RosBag, tree: TransformTree, color: str, timestamps: Sequence[float]
) -> Accelerometer | None:
    """Return the first usable accelerometer in a bag, or None if no accelerometer is usable.

    Args:
        bag: The bag.
        tree: The coordinate frames of the bag.
        color: The topic of the color images.
        timestamps: The timestamps of the color images, s.
    """
    reasons = []
    for topic in bag.topics(IMU):
        if GYROSCOPE.search(topic):
            continue
        found = _accelerometer(bag, tree, topic, color)
        if isinstance(found, str):
            reasons.append(found)
        elif all(found.up(timestamp) is None for timestamp in timestamps):
            reasons.append(f"{topic}: expected a measurement within {NEAR:g} s of a frame, got none")
        else:
            return found
    if reasons:
        log.warning("%s: up direction unknown; no accelerometer is usable: %s", bag.path, "; ".join(reasons))
    return None


def _accelerometer(bag: RosBag, tree: TransformTree, topic: str, color: str) -> Accelerometer | str:
    """Return the accelerometer of a topic, or the reason why it cannot be used."""
    times, measured, frame_id = _read(bag, topic)
    if not len(times):
        return f"{topic}: expected readable messages, got none"
    length = float(np.median(np.linalg.norm(measured, axis=1)))
    if abs(length - GRAVITY) > MAX_DEVIATION * GRAVITY:
        return f"{topic}: expected a median acceleration of {GRAVITY:g} m/s^2, got {length:.3g} m/s^2"
    imu = tree.frame_of(topic) if topic.startswith(REALSENSE) else frame_id
    try:
        T_camera_imu = tree.fixed(to=tree.frame_of(color), of=imu)
    except DataError as error:
        return f"{topic}: {error}"
    if T_camera_imu is None:
        return f"{topic}: expected the rotation from this sensor to the camera of {color} in the bag, got none"
    order = np.argsort(times, kind="stable")
    return Accelerometer(times[order], measured[order] @ T_camera_imu[:3, :3].T)


def _read(bag: RosBag, topic: str) -> tuple[Float64, Float64, str]:
    """Read the timestamps (N,), s, the accelerations (N, 3), m/s^2, and the frame id of a topic."""
    times, measured, frame_id, damaged = [], [], "", 0
    try:
        for message in bag.messages([topic]):
            try:
                content, time = bag.decoded(message), bag.sensed_at(message)
            except FrameError:
                damaged += 1
                continue
            vector = [getattr(content.linear_acceleration, name) for name in "xyz"]
            if np.isfinite(vector).all():
                times.append(time)
                measured.append(vector)
                frame_id = frame_id or content.header.frame_id
    except DataError as error:
        log.warning("%s; using the messages before the error", error)
    if damaged:
        log.warning("%s: skipped %d damaged messages of %s", bag.path, damaged, topic)
    return np.array(times), np.array(measured, np.float64).reshape(-1, 3), frame_id
