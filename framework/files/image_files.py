"""Image readers that reject damaged files.

Pillow accepts truncated files, so the end marker is checked here. JPEG files are decoded with simplejpeg, which
raises an error for damaged data. OpenCV fills the damaged regions without an error.
"""

from __future__ import annotations

import io
import shlex
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from PIL import ExifTags, Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from framework.data import MAX_PIXELS, Array, UInt8, UInt16
from framework.errors import DataError, FrameError, in_one_line
from framework.files.atomic_write import atomic_write, read_bytes

PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
JPEG_PADDING = b"\0\r\n"  # bytes after the end marker; some cameras append zeros; some programs append a line break
UPRIGHT = 1  # EXIF orientation of an image whose pixels are stored as displayed
LARGEST_FILE = 2**28  # bytes, size of MAX_PIXELS with four 16-bit channels


def exif_orientation(path: Path) -> int:
    """Return the EXIF orientation of an image file, from 1 (UPRIGHT) to 8, or UPRIGHT if the file has none."""
    try:
        with Image.open(path) as image:
            return int(image.getexif().get(ExifTags.Base.Orientation, UPRIGHT))
    except Exception:  # Pillow has no common base exception; reading the pixels reports damage
        return UPRIGHT


def rotation_command(path: Path) -> str:
    """Return the shell command that applies the EXIF orientation to the pixels of all images next to an image."""
    return mogrify("-auto-orient", path)


def mogrify(option: str, path: Path) -> str:
    """Return the shell command that applies an option of ImageMagick's mogrify to all images next to an image."""
    return f"mogrify {option} {shlex.quote(str(path.parent))}/*{path.suffix}"


def read_color(path: Path) -> UInt8:
    """Read an 8-bit color image (H, W, 3), RGB, from a JPEG or PNG file.

    Raises:
        FrameError: The file is damaged or not 8-bit.
    """
    return decode_color(path, read_image_file(path))


def decode_color(name: Path | str, data: bytes) -> UInt8:
    """Decode an 8-bit color image (H, W, 3), RGB, from the content of a JPEG or PNG file.

    Raises:
        FrameError: The content is damaged or not 8-bit. The message contains `name`.
    """
    check_image(name, data)
    if data.startswith(JPEG_START):
        try:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB", strict=True), np.uint8)
        except ValueError as error:
            raise FrameError(f"{name}: expected a decodable JPEG, got an error ({in_one_line(error)})") from error
    image = _decode_png(name, data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH)
    if image.dtype != np.uint8:
        raise FrameError(f"{name}: expected color with 8 bits per channel, got {image.dtype}")
    return np.asarray(image, np.uint8)


def read_uint16(path: Path) -> UInt16:
    """Read a 16-bit image (H, W) from a PNG file.

    Raises:
        FrameError: The file is damaged or has another type.
    """
    return decode_uint16(path, read_image_file(path))


def decode_uint16(name: Path | str, data: bytes) -> UInt16:
    """Decode a 16-bit image (H, W) from the content of a PNG file.

    Raises:
        FrameError: The content is damaged or has another type. The message contains `name`.
    """
    return np.asarray(_decode_channel(name, data, np.uint16), np.uint16)


def read_ids(path: Path) -> UInt16:
    """Read an 8-bit or 16-bit image (H, W) of ids from a PNG file.

    Raises:
        FrameError: The file is damaged or has another type.
    """
    return np.asarray(_decode_channel(path, read_image_file(path), np.uint16, np.uint8), np.uint16)


def read_uint8(path: Path) -> UInt8:
    """Read an 8-bit image (H, W) from a PNG file.

    Raises:
        FrameError: The file is damaged or has another type.
    """
    return np.asarray(_decode_channel(path, read_image_file(path), np.uint8), np.uint8)


def _decode_channel(name: Path | str, data: bytes, *dtypes: type[np.generic]) -> Array:
    check_image(name, data)
    image = _decode_png(name, data, cv2.IMREAD_UNCHANGED)
    if image.dtype not in dtypes or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        expected = " or ".join(dtype.__name__ for dtype in dtypes)
        raise FrameError(f"{name}: expected a PNG with 1 channel of {expected}, got {channels} of {image.dtype}")
    return image


def read_image_file(path: Path) -> bytes:
    """Return the content of an image file.

    Raises:
        FrameError: The file cannot be read.
    """
    try:
        return read_bytes(path, LARGEST_FILE)
    except DataError as error:
        raise FrameError(str(error)) from error


def _decode_png(name: Path | str, data: bytes, flags: int) -> Array:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{name}: expected a decodable PNG, got corrupt data")
    return np.asarray(image)


def write_image(path: Path, image: Array, *options: int) -> None:
    """Write one of many images atomically. The format is that of the suffix.

    The caller syncs the folder when all images are written (`atomic_write`).

    Args:
        path: The file.
        image: Color image (H, W, 3), BGR, or single-channel image (H, W).
        options: Options of `cv2.imencode`.

    Raises:
        DataError: The file cannot be written.
    """
    _, data = cv2.imencode(path.suffix, image, options)
    with atomic_write(path, sync_entry=False) as temporary:
        temporary.write_bytes(data.tobytes())


def check_image(name: Path | str, data: bytes) -> None:
    """Raise FrameError unless `data` is a complete PNG or JPEG image of at most MAX_PIXELS.

    Without this check, decoders allocate memory for the size in the header, which may be 10^10 px in a damaged file.
    """
    if not data:
        raise FrameError(f"{name}: expected an image, got an empty file")
    kind: type[ImageFile]
    if data.startswith(PNG_START):
        kind, ended = PngImageFile, data.rfind(PNG_END) >= 0
    elif data.startswith(JPEG_START):
        kind, ended = JpegImageFile, data.rstrip(JPEG_PADDING).endswith(JPEG_END)
    else:
        raise FrameError(f"{name}: expected a JPEG or PNG file, got a file that begins with {data[:8]!r}")
    if not ended:
        raise FrameError(
            f"{name}: expected an image with an end marker, got none in {len(data)} bytes (truncated file)"
        )
    try:
        image = kind(io.BytesIO(data))  # Image.open warns about large images and has its own limit
        width, height = image.size
        pictures = getattr(image, "n_frames", 1)
        image.verify()
    except Exception as error:  # Pillow has no common base exception
        raise FrameError(f"{name}: expected a valid image, got an error ({in_one_line(error)})") from error
    if pictures > 1:
        raise FrameError(f"{name}: expected a single image, got an animation of {pictures} images")
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f"{name}: expected an image of 1 to {MAX_PIXELS} px, got {width}x{height} px")
