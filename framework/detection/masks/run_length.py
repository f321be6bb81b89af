"""Run-length encoded masks in COCO's format.

Run lengths are the lengths of alternating runs of 0 and 1, column by column. They are stored as a list of numbers or as
a packed string. pycocotools packs and decodes them. Strings are validated here, because pycocotools 2.0.11 leaves the
pixels after a short string uninitialized.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from pycocotools import mask as coco

from framework.data import Bool, Int64
from framework.errors import DataError

FIRST_CHARACTER = 48  # encodes 0; a character has five bits of a number, and a sixth bit if more characters follow
MORE, SIGN, BITS = 0x20, 0x10, 5
MAX_CHARACTERS = 7  # maximum number of characters per number; its range exceeds the pixels of any image


def encode(masks: Bool) -> list[bytes]:
    """Encode masks (N, H, W) as packed run lengths."""
    columns_first = np.asfortranarray(masks.transpose(1, 2, 0).view(np.uint8))
    return [run["counts"] for run in coco.encode(columns_first)] if len(masks) else []


def decode(counts: Sequence[bytes], shape: tuple[int, int]) -> Bool:
    """Decode packed run lengths to masks (N, H, W).

    Validate untrusted run lengths with `check` first.
    """
    masks = np.zeros((len(counts), *shape), np.uint8)
    size = list(shape)
    for mask, packed in zip(masks, counts, strict=True):
        # pycocotools returns columns; OpenCV transposes several times faster than numpy
        cv2.transpose(coco.decode({"size": size, "counts": packed}).T, dst=mask)
    return masks.view(np.bool_)


def pack(lengths: Sequence[int], shape: tuple[int, int]) -> bytes:
    """Pack run lengths for an image of size `shape` (height, width).

    Raises:
        DataError: The run lengths do not fill the image.
    """
    if not all(isinstance(length, int) and not isinstance(length, bool) for length in lengths):
        raise DataError(f"run lengths: expected integers, got {lengths!r:.200}")
    _check_filled(np.array(lengths, np.float64), shape)
    packed: bytes = coco.frPyObjects({"size": list(shape), "counts": list(lengths)}, *shape)["counts"]
    return packed


def check(counts: bytes, shape: tuple[int, int]) -> None:
    """Raise DataError unless packed run lengths fill an image of size `shape` (height, width)."""
    _check_filled(unpack(counts), shape)


def unpack(counts: bytes) -> Int64:
    """Unpack a string to run lengths (R,).

    Raises:
        DataError: The string is invalid.
    """
    codes = np.frombuffer(counts, np.uint8).astype(np.int64) - FIRST_CHARACTER
    if not len(codes) or codes.min() < 0 or codes.max() >= 2 * MORE or codes[-1] & MORE:
        raise DataError(f"run lengths: expected a packed string in COCO's format, got {counts!r:.100}")
    ends = np.flatnonzero((codes & MORE) == 0)
    starts = np.concatenate([[0], ends[:-1] + 1])
    position = np.arange(len(codes)) - np.repeat(starts, ends - starts + 1)
    if position.max() >= MAX_CHARACTERS:
        raise DataError(
            f"run lengths: expected at most {MAX_CHARACTERS} characters per number, got {position.max() + 1} characters"
        )
    numbers = np.add.reduceat((codes & (MORE - 1)) << (BITS * position), starts)
    numbers -= np.where(codes[ends] & SIGN, 1 << (BITS * (position[ends] + 1)), 0)
    lengths = numbers.copy()
    for parity in (1, 2):
        lengths[parity::2] = np.cumsum(numbers[parity::2])
    return np.asarray(lengths, np.int64)


def _check_filled(lengths: np.ndarray[tuple[int, ...], np.dtype[np.generic]], shape: tuple[int, int]) -> None:
    height, width = shape
    negative = bool(lengths.size) and float(lengths.min()) < 0
    if negative or int(lengths.sum()) != height * width:
        found = "a negative length" if negative else f"{int(lengths.sum())} px"
        raise DataError(f"run lengths: expected {width}x{height} = {height * width} px, got {found}")
