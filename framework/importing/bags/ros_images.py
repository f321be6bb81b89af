"""Decoder of ROS image messages.

The functions read attributes of the messages only, so they also decode the messages of rclpy.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from framework.data import Array, Float32, UInt8, UInt16
from framework.errors import FrameError
from framework.files.image_files import PNG_START, decode_color, decode_uint16
from framework.files.rvl_images import decode_rvl
from framework.importing.source import readings

COLOR_CHANNELS = {  # by encoding: number of 8-bit channels, and indices of R, G and B
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
CONVERTED = {  # by encoding: number of 8-bit channels, and OpenCV's conversion to RGB
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
MILLIMETERS, METERS = ("16UC1", "mono16", "Z16"), ("32FC1",)
MILLIMETER = 0.001  # m
COMPRESSED_DEPTH, RVL = "compressedDepth", "rvl"  # in the format field of depth images
DEPTH_HEADER = struct.Struct("<iff")  # of compressedDepth: unused integer, quantization A and B of float depth


def decode_ros_color(where: str, message: Any) -> UInt8:
    """Decode a color image (H, W, 3), RGB.

    Args:
        where: The location of the message, for error messages.
        message: The sensor_msgs/Image or CompressedImage message.

    Raises:
        FrameError: The image is invalid. The message contains `where`.
    """
    if not hasattr(message, "encoding"):
        return decode_color(where, bytes(message.data))
    if message.encoding in CONVERTED:
        channels, conversion = CONVERTED[message.encoding]
        pixels = _pixels(where, message, np.dtype(np.uint8), channels)
        try:
            return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
        except cv2.error as error:
            found = f"{message.width}x{message.height} px"
            raise FrameError(f"{where}: expected an even size in {message.encoding}, got {found}") from error
    if message.encoding not in COLOR_CHANNELS:
        expected = f"expected one of the color encodings {', '.join((*COLOR_CHANNELS, *CONVERTED))}"
        raise FrameError(f"{where}: {expected}, got {message.encoding[:60]!r}")
    channels, order = COLOR_CHANNELS[message.encoding]
    return np.ascontiguousarray(_pixels(where, message, np.dtype(np.uint8), channels)[..., order])


def decode_ros_depth(where: str, message: Any, unit: float = MILLIMETER, float_unit: float = 1.0) -> Float32:
    """Decode a depth image (H, W), m, 0 = no reading.

    Args:
        where: The location of the message, for error messages.
        message: The sensor_msgs/Image or CompressedImage message.
        unit: The unit of integer depth, m.
        float_unit: The unit of float depth, m.

    Raises:
        FrameError: The image is invalid.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(where, message, unit, float_unit)
    if message.encoding in MILLIMETERS:
        return _whole(_pixels(where, message, np.dtype(f"{_byte_order(message)}u2"), 1)[..., 0], unit)
    if message.encoding in METERS:
        stored = _pixels(where, message, np.dtype(f"{_byte_order(message)}f4"), 1)[..., 0]
        return readings(stored.astype(np.float32)) * np.float32(float_unit)
    known = ", ".join((*MILLIMETERS, *METERS))
    raise FrameError(f"{where}: expected one of the depth encodings {known}, got {message.encoding[:60]!r}")


def shows_depth(message: Any) -> bool | None:
    """Return True for the encodings of depth images, False for those of color images, and None for all others."""
    stored = message.encoding if hasattr(message, "encoding") else message.format
    encoding = stored.partition(";")[0].strip()  # `16UC1; compressedDepth png`
    if encoding in COLOR_CHANNELS or encoding in CONVERTED:
        return False
    return True if encoding in (MILLIMETERS[0], *METERS) or COMPRESSED_DEPTH in stored else None


def _byte_order(message: Any) -> str:
    return ">" if message.is_bigendian else "<"


def _whole(stored: Array, unit: float) -> Float32:
    return np.where(stored == np.iinfo(np.uint16).max, 0, stored).astype(np.float32) * np.float32(unit)


def _compressed_depth(where: str, message: Any, unit: float, float_unit: float) -> Float32:
    """Decode a compressed depth image (H, W), m, 0 = no reading."""
    encoding, data = message.format.partition(";")[0].strip(), bytes(message.data)
    is_float = encoding in METERS
    if data.startswith(PNG_START) and not is_float:  # `compressed`, which has no header
        return _whole(decode_uint16(where, data), unit)
    if len(data) < DEPTH_HEADER.size:
        raise FrameError(f"{where}: expected a header of {DEPTH_HEADER.size} bytes and an image, got {len(data)} bytes")
    _, quantization_a, quantization_b = DEPTH_HEADER.unpack_from(data)
    decode = decode_rvl if RVL in message.format.lower() else decode_uint16
    stored = decode(where, data[DEPTH_HEADER.size :])
    if not is_float:
        return _whole(stored, unit)
    return inverse_depth(stored, quantization_a, quantization_b) * np.float32(float_unit)


def inverse_depth(stored: UInt16, quantization_a: float, quantization_b: float) -> Float32:
    """Return the depth (H, W), m, of a quantized inverse depth image: A / (value - B); 0 = no reading."""
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
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, :row]
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
