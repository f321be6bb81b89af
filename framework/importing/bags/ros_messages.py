"""Reader of ROS bags and decoder of image messages.

Only standard message types are supported. Message definitions in a bag are ignored, because rosbags would generate code
from them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Array, Float32, UInt8
from framework.errors import DataError, FrameError, import_optional, in_one_line
from framework.files.image_files import decode_color, decode_uint16
from framework.files.number_lines import SHOWN
from framework.importing.source import readings

NANOSECONDS = 1e-9  # s
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU, TRANSFORMS = "sensor_msgs/msg/Imu", "tf2_msgs/msg/TFMessage"
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"

COLOR_CHANNELS = {  # by encoding: number of 8-bit channels, and indices of R, G and B
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
MILLIMETERS, METERS = ("16UC1", "mono16", "Z16"), ("32FC1",)
COMPRESSED_DEPTH = "compressedDepth"  # in the format field of depth images, after the encoding
DEPTH_HEADER = struct.Struct("<iff")  # of compressedDepth: unused integer, quantization A and B


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
        if TRANSFORMS not in self._types.types:  # rosbags does not define this type for ROS 1
            definition = "geometry_msgs/TransformStamped[] transforms"
            self._types.register(typesys.get_types_from_msg(definition, TRANSFORMS))
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


def color_of(where: str, message: Any) -> UInt8:
    """Decode a color image (H, W, 3), RGB.

    Raises:
        FrameError: The image is invalid. The message contains `where`.
    """
    if hasattr(message, "format"):
        return decode_color(where, message.data.tobytes())
    if message.encoding not in COLOR_CHANNELS:
        expected = f"expected one of the color encodings {', '.join(COLOR_CHANNELS)}"
        raise FrameError(f"{where}: {expected}, got {message.encoding[:60]!r}")
    channels, order = COLOR_CHANNELS[message.encoding]
    return np.ascontiguousarray(_pixels(where, message, np.dtype(np.uint8), channels)[..., order])


def depth_of(where: str, message: Any, unit: float) -> Float32:
    """Decode a depth image (H, W), m, 0 = no reading.

    Args:
        where: The location in the bag, for messages.
        message: The decoded Image or CompressedImage message.
        unit: The unit of integer depth, m.

    Raises:
        FrameError: The image is invalid.
    """
    if hasattr(message, "format"):
        return _compressed_depth(where, message, unit)
    order = ">" if message.is_bigendian else "<"
    if message.encoding in MILLIMETERS:
        return _whole(_pixels(where, message, np.dtype(f"{order}u2"), 1)[..., 0], unit)
    if message.encoding in METERS:
        return readings(_pixels(where, message, np.dtype(f"{order}f4"), 1)[..., 0].astype(np.float32))
    known = ", ".join((*MILLIMETERS, *METERS))
    raise FrameError(f"{where}: expected one of the depth encodings {known}, got {message.encoding[:60]!r}")


def _whole(stored: Array, unit: float) -> Float32:
    return np.where(stored == np.iinfo(np.uint16).max, 0, stored).astype(np.float32) * np.float32(unit)


def _compressed_depth(where: str, message: Any, unit: float) -> Float32:
    """Decode a compressed depth image (H, W), m, 0 = no reading."""
    encoding, _, codec = message.format.partition(";")
    data = message.data.tobytes()
    if COMPRESSED_DEPTH not in codec:
        return _whole(decode_uint16(where, data), unit)
    if "rvl" in codec.lower():
        raise FrameError(f"{where}: expected PNG or uncompressed depth, got RVL; record depth as PNG or uncompressed")
    if len(data) < DEPTH_HEADER.size:
        raise FrameError(f"{where}: expected a header of {DEPTH_HEADER.size} bytes and an image, got {len(data)} bytes")
    # for float depth, the header contains the quantization of inverse depth: depth = A / (value - B)
    _, quantization_a, quantization_b = DEPTH_HEADER.unpack_from(data)
    stored = decode_uint16(where, data[DEPTH_HEADER.size :])
    if encoding.strip() not in METERS:
        return _whole(stored, unit)
    with np.errstate(all="ignore"):
        return readings(np.where(stored == 0, 0, quantization_a / (stored.astype(np.float64) - quantization_b)))


def _pixels(where: str, message: Any, dtype: np.dtype[Any], channels: int) -> Array:
    """Return the pixels (H, W, channels) of an Image."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    if not 0 < row <= step or height < 1 or len(message.data) != height * step:
        layout = f"{width}x{height} px of {message.encoding[:60]!r} with {step} bytes per row"
        raise FrameError(
            f"{where}: expected {height * max(row, step)} bytes for {layout}, got {len(message.data)} bytes"
        )
    rows = np.asarray(message.data, np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
