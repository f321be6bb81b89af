"""Decoder of 16-bit depth images in RVL, as written by compressed_depth_image_transport and RTAB-Map.

    uint32 width, uint32 height, and the code: 32-bit words of eight 4-bit groups, the most significant group first

A number consists of groups with 3 bits each, the least significant group first. The fourth bit of a group is set if
another group follows. The numbers are the count of pixels without a reading, the count of pixels with readings, their
differences to the previous readings, and so on. A difference d is stored as 2 d, or as -2 d - 1 if it is negative.

Source: A. D. Wilson, Fast lossless depth image compression, ISS 2017.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from framework.data import MAX_PIXELS, UInt16
from framework.errors import FrameError

HEADER = struct.Struct("<II")  # width and height, px
LONGEST_NUMBER = 10  # groups of a 32-bit number


def decode_rvl(name: Path | str, data: bytes) -> UInt16:
    """Decode a depth image (H, W).

    Raises:
        FrameError: The content is damaged. The message contains `name`.
    """
    if len(data) < HEADER.size:
        raise FrameError(f"{name}: expected an RVL image, got {len(data)} bytes")
    width, height = HEADER.unpack_from(data)
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f"{name}: expected an RVL image of 1 to {MAX_PIXELS} px, got {width}x{height} px")
    numbers = _numbers(data[HEADER.size :])
    differences = np.where(numbers & 1, -(numbers >> 1) - 1, numbers >> 1)
    steps = np.zeros(width * height, np.int64)
    has_reading = np.zeros(width * height, bool)
    pixel = number = 0
    corrupt = FrameError(f"{name}: expected an RVL image of {width}x{height} px, got corrupt data")
    while pixel < width * height:
        empty, count = numbers[number : number + 2].tolist() if number + 2 <= len(numbers) else (0, 0)
        first, start = number + 2, pixel + empty
        number, pixel = first + count, start + count
        if empty + count == 0 or number > len(numbers) or pixel > width * height:
            raise corrupt
        steps[start:pixel], has_reading[start:pixel] = differences[first:number], True
    if numbers[number:].any():  # the last word is padded with zeros
        raise corrupt
    return np.where(has_reading, np.cumsum(steps), 0).astype(np.uint16).reshape(height, width)


def _numbers(code: bytes) -> NDArray[np.int64]:
    """Return the numbers (N,), int64."""
    words = np.frombuffer(code[: len(code) // 4 * 4], "<u4")
    groups = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).ravel().astype(np.int64)
    is_last = groups < 8
    ends = np.flatnonzero(is_last)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if not len(ends):
        return np.zeros(0, np.int64)
    groups, position = groups[: ends[-1] + 1], np.arange(ends[-1] + 1)
    place = position - np.repeat(starts, ends - starts + 1)
    return np.asarray(np.add.reduceat((groups & 7) << 3 * np.minimum(place, LONGEST_NUMBER), starts), np.int64)
