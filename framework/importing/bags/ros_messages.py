"""Reader of ROS bags.

Only standard message types are supported. Message definitions in a bag are ignored, because rosbags would generate code
from them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.errors import DataError, FrameError, import_optional, in_one_line
from framework.files.number_lines import SHOWN

NANOSECONDS = 1e-9  # s
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the second type is of early ROS 1
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM, PATH = "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Path"


@dataclass(frozen=True)
class Message:
    """An undecoded message."""

    topic: str
    kind: str  # message type
    stored_at: float  # s, recording time
    raw: bytes


class RosBag:
    """A ROS 1 bag, or a ROS 2 bag as a folder, .mcap file or .db3 file."""

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            DataError: The bag cannot be read.
            ConfigError: The package rosbags is not installed.
        """
        self.path = path
        import_optional("rosbags", "reads ROS bags", "ros")
        from rosbags import rosbag1, rosbag2, typesys

        self._is_ros1 = path.suffix.lower() == ".bag"
        self._types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if self._is_ros1 else typesys.Stores.LATEST)
        for name in TRANSFORMS:
            if name not in self._types.types:  # rosbags does not define these types for ROS 1
                definition = "geometry_msgs/TransformStamped[] transforms"
                self._types.register(typesys.get_types_from_msg(definition, name))
        try:
            self._reader = (rosbag1 if self._is_ros1 else rosbag2).Reader(path)
            self._reader.open()
            self.kinds: dict[str, str] = {found.topic: found.msgtype for found in self._reader.connections}
        except Exception as error:  # rosbags has no common base exception
            raise DataError(f"{path}: expected a ROS bag, got an error ({in_one_line(error)[:SHOWN]})") from error

    def topics(self, *kinds: str) -> list[str]:
        """Return the topics with given message types."""
        return sorted(topic for topic, kind in self.kinds.items() if kind in kinds)

    def messages(self, topics: Sequence[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of recording.

        Raises:
            DataError: The bag is damaged.
        """
        chosen = [found for found in self._reader.connections if found.topic in topics]
        if not chosen:
            return
        try:
            for connection, stored_at, raw in self._reader.messages(chosen):
                yield Message(connection.topic, connection.msgtype, stored_at * NANOSECONDS, bytes(raw))
        except Exception as error:  # rosbags has no common base exception
            reason = in_one_line(error)[:SHOWN]
            raise DataError(f"{self.path}: expected readable messages, got an error ({reason})") from error

    def first(self, topic: str) -> Any:
        """Return the decoded first message of a topic, or None without messages.

        Raises:
            DataError: The bag is damaged.
        """
        message = next(self.messages([topic]), None)
        return None if message is None else self.decoded(message)

    def decoded(self, message: Message) -> Any:
        """Decode a message.

        Raises:
            FrameError: The message is damaged.
        """
        decode = self._types.deserialize_ros1 if self._is_ros1 else self._types.deserialize_cdr
        try:
            return decode(message.raw, message.kind)
        except Exception as error:  # rosbags has no common base exception
            reason = in_one_line(error)[:SHOWN]
            raise FrameError(
                f"{self.path}: {message.topic}: expected a valid message, got an error ({reason})"
            ) from error

    def sensed_at(self, message: Message) -> float:
        """Return the timestamp in the header of a message, s.

        The header must be the first field.

        Raises:
            FrameError: The message is too short for a header.
        """
        try:
            if self._is_ros1:
                seconds, nanoseconds = struct.unpack_from("<xxxxII", message.raw)
            else:
                order = "<" if message.raw[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(f"{order}xxxxiI", message.raw)
        except (struct.error, IndexError) as error:
            raise FrameError(f"{self.path}: expected a header in a message of {message.topic}, got none") from error
        return (int(seconds) * 10**9 + int(nanoseconds)) * NANOSECONDS
