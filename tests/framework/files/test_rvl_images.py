"""Tests for the decoder of RVL images."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from framework.errors import FrameError
from framework.files.rvl_images import decode_rvl
from tests.support.recordings.rvl_files import rvl

RANDOM = np.random.default_rng(0)
NOISE = (RANDOM.integers(1, 65536, (24, 33)) * (RANDOM.random((24, 33)) > 0.4)).astype(np.uint16)


def test_decode_rvl_known_bytes_give_known_values() -> None:
    """Worked by hand: no empty pixel, 2 readings (1000, then -3), 1 empty pixel, no reading.

    The numbers 0, 2, 2000, 5, 1, 0 in groups of 3 bits: 0, 2, 0|8 2|8 7|8 3, 5, 1, 0.
    """
    code = struct.pack("<4I", 3, 1, 0x028AF351, 0x00000000)
    np.testing.assert_array_equal(decode_rvl("a", code), [[1000, 997, 0]])


@pytest.mark.parametrize(
    "image",
    [NOISE, NOISE * (NOISE > 60_000), np.zeros((3, 5)), np.full((1, 1), 65535), np.arange(1, 13).reshape(2, 6)],
)
def test_decode_rvl_returns_written_image(image: np.ndarray) -> None:
    stored = image.astype(np.uint16)
    np.testing.assert_array_equal(decode_rvl("a", rvl(stored)), stored)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "got 0 bytes"),
        (struct.pack("<2I", 0, 5), "got 0x5 px"),
        (struct.pack("<2I", 2**31, 2**31), "got 2147483648x2147483648 px"),
        (struct.pack("<2I", 4, 4), "corrupt data"),
        (struct.pack("<3I", 4, 4, 0), "corrupt data"),
        (rvl(NOISE)[:-8], "of 33x24 px, got corrupt data"),
        (struct.pack("<2I", 5, 5) + rvl(NOISE)[8:], "of 5x5 px, got corrupt data"),
        (struct.pack("<4I", 4, 4, 0xFFFFFFFF, 0xFFFFFFFF), "corrupt data"),
    ],
)
def test_decode_rvl_damaged_image_raises(data: bytes, message: str) -> None:
    with pytest.raises(FrameError, match=f"^a: expected an RVL image.*{message}"):
        decode_rvl("a", data)
