"""Images read strictly: a damaged file is an error, never a half-grey picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from framework.data import Array, UInt8, UInt16
from framework.errors import DataError, FrameError
from framework.files.image_header import check_image
from framework.files.whole_files import read_bytes

LARGEST_FILE = 2**28  # bytes; MOST_PIXELS of four channels of 16 bits, unpacked


def read_color(path: Path) -> UInt8:
    """The (H, W, 3) uint8 RGB of a JPEG or PNG file. Raises FrameError when it is damaged or not 8-bit."""
    return decode_color(path, _read(path))


def decode_color(name: Path | str, data: bytes) -> UInt8:
    """Likewise, of what such a file holds; `name` is for messages."""
    image = _decode(name, data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH)
    if image.dtype != np.uint8:
        raise FrameError(f"{name}: colour must be 8 bits a channel, found {image.dtype}")
    return np.asarray(image, np.uint8)


def read_uint16(path: Path) -> UInt16:
    """The (H, W) uint16 values of a PNG file. Raises FrameError when it is damaged or of another type."""
    image = _decode(path, _read(path), cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FrameError(f"{path} must be a PNG with one channel of uint16, found {channels} of {image.dtype}")
    return np.asarray(image, np.uint16)


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, LARGEST_FILE)
    except DataError as error:
        raise FrameError(str(error)) from error


def _decode(name: Path | str, data: bytes, flags: int) -> Array:
    check_image(name, data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{name} could not be decoded: the file is damaged")
    return np.asarray(image)
