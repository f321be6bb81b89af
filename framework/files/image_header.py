"""What a PNG or JPEG file says before it is decoded: whether it is whole, and how large its picture is."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from framework.errors import FrameError

MOST_PIXELS = 2**25  # 8K video; decoders allocate what a header claims, and a damaged one can claim 10^10
PNG_START, PNG_HEADER, PNG_END = b"\x89PNG\r\n\x1a\n", b"IHDR", b"IEND"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
JPEG_PADDING = b"\0\r\n"  # some cameras fill their files up with zeros, and some programs add a line end
JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the markers SOF of ITU T.81, table B.1
JPEG_SCAN = 0xDA  # the marker SOS: the picture begins


def check_image(name: Path | str, data: bytes) -> None:
    """Raises FrameError, naming the byte, unless `data` is a whole PNG or JPEG file with a picture of a usual size.

    OpenCV decodes a JPEG that ends too early without a word (seen in 4.x) and allocates whatever a header claims.
    """
    if not data:
        raise FrameError(f"{name} is empty")
    if data.startswith(PNG_START):
        width, height = _png_size(name, data)
    elif data.startswith(JPEG_START):
        width, height = _jpeg_size(name, data)
    else:
        raise FrameError(f"{name} is neither a JPEG nor a PNG file")
    if not 0 < width * height <= MOST_PIXELS:
        raise FrameError(f"{name} claims to be {width}x{height} px; it is damaged, or larger than {MOST_PIXELS} px")


def _png_size(name: Path | str, data: bytes) -> tuple[int, int]:
    """(width, height) of a PNG file whose every chunk is there, with the right checksum."""
    width = height = 0
    position = len(PNG_START)
    while True:
        length, kind = int.from_bytes(data[position : position + 4], "big"), data[position + 4 : position + 8]
        checksum = position + 8 + length
        if checksum + 4 > len(data):
            raise FrameError(
                f"{name} is truncated: it ends at byte {len(data)}, in the chunk that begins at {position}"
            )
        if zlib.crc32(data[position + 4 : checksum]) != int.from_bytes(data[checksum : checksum + 4], "big"):
            raise FrameError(f"{name}, byte {position}: the file is damaged: the checksum of this chunk is wrong")
        if kind == PNG_HEADER and length >= 8:
            width, height = struct.unpack_from(">II", data, position + 8)
        if kind == PNG_END:
            return width, height
        position = checksum + 4


def _jpeg_size(name: Path | str, data: bytes) -> tuple[int, int]:
    """(width, height) of a JPEG file that has its end."""
    if not data.rstrip(JPEG_PADDING).endswith(JPEG_END):
        raise FrameError(f"{name} is truncated: it ends after {len(data)} bytes without its end marker")
    position = len(JPEG_START)
    while position + 9 <= len(data) and data[position] == 0xFF and data[position + 1] != JPEG_SCAN:
        marker, length = struct.unpack_from(">xBH", data, position)
        if marker in JPEG_SIZES:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        position += 1 if marker == 0xFF else 2 + length  # 0xFF before a marker only fills
    raise FrameError(f"{name}, byte {position}: the file is damaged: its picture's size should be told before this")
