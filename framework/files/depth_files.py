"""Readers of depth images in PNG, TIFF, NPY and EXR files.

.png                16 bits, in depth units of the recording
.tif, .tiff, .npy   16 bits, in depth units of the recording, or floats in meters
.exr                floats in meters, in the only channel, or in the one named Z, V or Y
"""

from __future__ import annotations

import io
import math
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL.TiffImagePlugin import TiffImageFile

from framework.data import MAX_PIXELS, Array, Float32, UInt16
from framework.errors import FrameError, import_optional, reason_of
from framework.files.image_files import read_image_file, read_uint16
from framework.files.number_lines import SHOWN

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
CHANNELS = ("Z", "V", "Y")  # names of depth channels in EXR files, in order of preference
NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
FARTHEST = 65.535  # m, maximum plausible median of float depth; larger values are not meters

_load_openexr = partial(import_optional, "OpenEXR", "reads EXR files", "phone")


def read_depth(path: Path) -> UInt16 | Float32:
    """Read a depth image (H, W): uint16 in depth units of the recording, or float32 in meters.

    Raises:
        FrameError: The file is damaged or has another type.
        ConfigError: The package OpenEXR is required, but not installed.
    """
    match path.suffix.lower():
        case ".tif" | ".tiff":
            return _depth_array(path, _read_tiff(path))
        case ".npy":
            return _depth_array(path, _read_npy(path))
        case ".exr":
            return _depth_array(path, _read_exr(path))
    return read_uint16(path)


def _depth_array(path: Path, image: Array) -> UInt16 | Float32:
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    is_float = np.issubdtype(image.dtype, np.floating)
    is_integer = image.dtype == np.uint16 or _is_uint16(image)
    if image.ndim != 2 or not 0 < image.size <= MAX_PIXELS or not (is_integer or is_float):
        shape = "x".join(map(str, image.shape))
        raise FrameError(f"{path}: expected one channel of uint16 or floats, got {shape} values of {image.dtype}")
    return np.ascontiguousarray(image, np.uint16) if is_integer else np.ascontiguousarray(image, np.float32)


def _is_uint16(image: Array) -> bool:
    """Return True for integers of 16 bits or more within the range of uint16, which some programs write."""
    is_wide = np.issubdtype(image.dtype, np.integer) and image.dtype.itemsize >= 2 and image.size > 0
    return bool(is_wide and image.min() >= 0 and image.max() <= np.iinfo(np.uint16).max)


def _read_tiff(path: Path) -> Array:
    data = read_image_file(path)
    try:
        image = TiffImageFile(io.BytesIO(data))
    except SyntaxError:  # Pillow does not read float64
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if decoded is not None and decoded.dtype == np.float64:
            return np.asarray(decoded)
        raise FrameError(f"{path}: expected a TIFF image of uint16 or floats, got another type") from None
    except Exception as error:  # Pillow has no common base exception
        raise FrameError(f"{path}: expected a TIFF image, got an error ({reason_of(error)})") from error
    try:
        pages, (width, height) = image.n_frames, image.size
        if pages > 1 or width * height > MAX_PIXELS:
            raise ValueError(f"{pages} pages of {width}x{height} px")
        return np.asarray(image)
    except Exception as error:  # Pillow has no common base exception
        raise FrameError(f"{path}: expected a TIFF of one page, got an error ({reason_of(error)})") from error


def _read_npy(path: Path) -> Array:
    data = read_image_file(path)  # an error of the disk would end the process if the file was mapped to memory
    try:
        with io.BytesIO(data) as stream:
            shape, column_major, dtype = NPY_HEADERS[np.lib.format.read_magic(stream)](stream)
            values = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
        return np.array(values.reshape(shape, order="F" if column_major else "C"))
    except (KeyError, ValueError, EOFError, MemoryError) as error:
        raise FrameError(f"{path}: expected a NumPy array, got an error ({reason_of(error)})") from error


def _read_exr(path: Path) -> Array:
    OpenEXR: Any = _load_openexr()
    data = read_image_file(path)
    try:  # the header is checked first, because it determines the required memory
        header = OpenEXR.File(io.BytesIO(data), header_only=True).header()
        low, high = header["dataWindow"]
        names = [channel.name for channel in header["channels"]]
        if int(np.prod((high - low + 1).astype(np.int64))) > MAX_PIXELS:
            raise ValueError(f"data window {low} to {high}")
        name = _depth_channel(path, names)
        return np.array(OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()[name].pixels)
    except FrameError:
        raise
    except Exception as error:  # OpenEXR has no common base exception
        raise FrameError(f"{path}: expected an EXR file, got an error ({reason_of(error)})") from error


def _depth_channel(path: Path, names: list[str]) -> str:
    """Return the name of the depth channel; layers precede the names of channels, as in `ViewLayer.Depth.Z`."""
    if len(names) == 1:
        return names[0]
    for channel in CHANNELS:
        found = [name for name in names if name.rpartition(".")[2] == channel]
        if len(found) == 1:
            return found[0]
    expected = f"expected one channel, or one of the channels {', '.join(CHANNELS)}"
    raise FrameError(f"{path}: {expected}, got {', '.join(names)[:SHOWN]}")
