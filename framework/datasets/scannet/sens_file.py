"""Reader of ScanNet's `.sens` files, version 4.

    uint32 version, uint64 n, n bytes: sensor name
    float32[64]     four 4x4 matrices: color intrinsics, color extrinsics, depth intrinsics, depth extrinsics
    int32[2]        compression of color (0 raw, 1 PNG, 2 JPEG) and depth (0 raw, 1 zlib, 2 Occipital)
    uint32[4]       width and height of color, width and height of depth
    float32         depth units per meter
    uint64          number of frames
    for each frame: float32[16] T_world_camera, uint64[2] timestamps of color and depth (microseconds),
                    uint64[2] sizes of color and depth (bytes), color image, depth image
    (IMU measurements at the end are not read)

All values are little-endian. `open_sens` reads only the header and the 96 bytes before each frame's images.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import BinaryIO

import numpy as np

from framework.data import MAX_PIXELS, Camera, Float64, UInt8, UInt16
from framework.datasets.frames.conventions import check_depth_scale
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, FrameError, StorageError
from framework.files.atomic_write import check_regular
from framework.files.image_files import decode_color
from framework.files.number_lines import PrintedMatrix

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2  # compression of color
ZLIB, OCCIPITAL = 1, 2  # compression of depth, in addition to RAW
LONGEST_NAME = 1024  # bytes of the sensor name; "StructureSensor" has 15
MAX_FRAMES = 2**18  # maximum number of frames, 2.4 hours at 30 Hz; the longest ScanNet video has about 6,000
START = struct.Struct("<IQ")
MATRIX_BYTES = 64
IMAGES = struct.Struct("<iiIIIIfQ")
FRAME = struct.Struct("<64s4Q")
OVERHEAD = 2**16  # bytes; a compressed image has at most twice the raw size plus this overhead


@dataclass(frozen=True)
class SensHeader:
    """Header of a .sens file."""

    color_camera: Camera
    depth_camera: Camera
    color_extrinsics: PrintedMatrix  # direction undocumented; the identity in all published files
    depth_extrinsics: PrintedMatrix  # direction undocumented
    color_compression: int  # RAW, PNG or JPEG
    depth_compression: int  # RAW or ZLIB
    depth_scale: float  # units per meter
    frames: int  # number of frames according to the header


@dataclass(frozen=True)
class SensFrame:
    """A frame of a .sens file, with images that are read on demand."""

    path: Path
    header: SensHeader
    number: int
    byte: int  # file position of the color image; the depth image follows the color image
    color_bytes: int
    depth_bytes: int
    color_time: int  # microseconds
    depth_time: int  # microseconds
    camera_to_world: PrintedMatrix  # T_world_camera; -inf = unknown

    @property
    def images(self) -> StoredImages:
        """The color and depth images, not registered to each other."""
        return StoredImages(self._color_name, self._depth_name, self.color, self.depth)

    @property
    def _color_name(self) -> str:
        return f"{self.path}, color of frame {self.number} at byte {self.byte}"

    @property
    def _depth_name(self) -> str:
        return f"{self.path}, depth of frame {self.number} at byte {self.byte + self.color_bytes}"

    def color(self) -> UInt8:
        """Return the image (H, W, 3), RGB, of the color camera.

        Raises:
            FrameError: The image is damaged.
            StorageError: The file cannot be read.
        """
        data = self._read(self._color_name, self.byte, self.color_bytes)
        if self.header.color_compression != RAW:
            return decode_color(self._color_name, data)
        shape = (*self.header.color_camera.shape, 3)
        _check_length(self._color_name, len(data), prod(shape))
        return np.frombuffer(data, np.uint8).reshape(shape)

    def depth(self) -> UInt16:
        """Return the depth (H, W) of the depth camera in device units, 0 = no reading.

        Raises:
            FrameError: The image is damaged.
            StorageError: The file cannot be read.
        """
        data = self._read(self._depth_name, self.byte + self.color_bytes, self.depth_bytes)
        shape = self.header.depth_camera.shape
        length = 2 * prod(shape)
        if self.header.depth_compression == ZLIB:
            data = _inflate(self._depth_name, data, length)
        _check_length(self._depth_name, len(data), length)
        return np.frombuffer(data, "<u2").reshape(shape).astype(np.uint16, copy=False)

    def _read(self, name: str, byte: int, length: int) -> bytes:
        try:
            with self.path.open("rb") as file:  # opened for each image, because several threads read frames
                file.seek(byte)
                data = file.read(length)
        except OSError as error:
            reason = f"expected a readable file, got an error ({error.strerror or error})"
            raise StorageError(f"{name}: {reason}; reconnect its disk and repeat the command") from error
        _check_length(name, len(data), length)
        return data


@dataclass(frozen=True)
class SensFile:
    """Contents of a .sens file."""

    header: SensHeader
    frames: tuple[SensFrame, ...]  # complete frames before the first incomplete frame
    cut: str  # reason for fewer frames than header.frames; "" = all frames are complete


def open_sens(path: Path) -> SensFile:
    """Read the header and the file positions of the frames.

    Raises:
        DataError: The file is unreadable, the header is invalid, or there is no complete frame.
    """
    check_regular(path)
    try:
        with path.open("rb", buffering=0) as file:
            length = file.seek(0, 2)
            file.seek(0)
            header = _read_header(path, file, length)
            frames, cut = _find_frames(path, file, length, header)
    except OSError as error:
        raise DataError(f"{path}: expected a readable file, got an error ({error.strerror or error})") from error
    if not frames:
        reason = cut or "frame count in the header: 0"
        raise DataError(f"{path}: expected at least one complete frame, got none ({reason})")
    return SensFile(header, tuple(frames), cut)


def _read_header(path: Path, file: BinaryIO, length: int) -> SensHeader:
    def take(count: int) -> bytes:
        data = file.read(count)
        if len(data) < count:
            at = file.tell() - len(data)
            raise DataError(f"{path}, byte {at}: expected a full header, got the end of the file at byte {length}")
        return data

    version, name_bytes = START.unpack(take(START.size))
    if version != VERSION:
        raise DataError(f"{path}, byte 0: expected version {VERSION} of the .sens format, got {version}")
    if name_bytes > LONGEST_NAME:
        raise DataError(f"{path}, byte 4: expected a sensor name of at most {LONGEST_NAME} bytes, got {name_bytes}")
    take(name_bytes)
    color_intrinsics, color_extrinsics, depth_intrinsics, depth_extrinsics = (
        _matrix(f"{path}, byte {file.tell()}", take(MATRIX_BYTES)) for _ in range(4)
    )
    at = file.tell()
    color_code, depth_code, *sizes, depth_scale, frames = IMAGES.unpack(take(IMAGES.size))
    for name, width, height in (("color", *sizes[:2]), ("depth", *sizes[2:])):
        if not 0 < width * height <= MAX_PIXELS:
            expected = f"expected {name} images of 1 to {MAX_PIXELS} px"
            raise DataError(f"{path}, byte {at + 8}: {expected}, got {width}x{height} px")
    check_depth_scale(f"{path}, byte {at + 24}: depth scale", depth_scale)
    if frames > MAX_FRAMES or frames * FRAME.size > length:
        most = min(MAX_FRAMES, length // FRAME.size)
        raise DataError(f"{path}, byte {at + 28}: expected at most {most} frames in {length} bytes, got {frames}")
    if depth_code == OCCIPITAL:
        raise DataError(
            f"{path}, byte {at + 4}: expected raw or zlib depth, got Occipital's proprietary compression; export the "
            "frames with ScanNet's SensReader"
        )
    compressions = (at, "color", color_code, (RAW, PNG, JPEG)), (at + 4, "depth", depth_code, (RAW, ZLIB))
    for byte, name, code, known in compressions:
        if code not in known:
            raise DataError(f"{path}, byte {byte}: expected a compression of {name} in {known}, got {code}")
    color_camera, depth_camera = color_intrinsics.camera(*sizes[:2]), depth_intrinsics.camera(*sizes[2:])
    extrinsics = color_extrinsics, depth_extrinsics
    return SensHeader(color_camera, depth_camera, *extrinsics, color_code, depth_code, depth_scale, frames)


def _matrix(where: str, data: bytes) -> PrintedMatrix:
    values: Float64 = np.frombuffer(data, "<f4").reshape(4, 4).astype(np.float64)
    return PrintedMatrix(where, values)


def _find_frames(path: Path, file: BinaryIO, length: int, header: SensHeader) -> tuple[list[SensFrame], str]:
    """Return the complete frames and the reason for missing frames ("" = none are missing)."""
    most_color = 2 * 3 * prod(header.color_camera.shape) + OVERHEAD
    most_depth = 2 * 2 * prod(header.depth_camera.shape) + OVERHEAD
    frames: list[SensFrame] = []
    at = file.tell()
    for number in range(header.frames):
        ended = f"byte {at}: the file ends at byte {length}, within frame {number} of {header.frames}"
        images = at + FRAME.size
        if images > length:
            return frames, ended
        file.seek(at)
        pose, color_time, depth_time, color_bytes, depth_bytes = FRAME.unpack(file.read(FRAME.size))
        if color_bytes > most_color or depth_bytes > most_depth:
            expected = f"frame {number}: expected at most {most_color} bytes of color and {most_depth} of depth"
            return frames, f"byte {at}: {expected}, got {color_bytes} and {depth_bytes}"
        if images + color_bytes + depth_bytes > length:
            return frames, ended
        T_world_camera = _matrix(f"{path}, byte {at}", pose)
        sizes = color_bytes, depth_bytes
        frames.append(SensFrame(path, header, number, images, *sizes, color_time, depth_time, T_world_camera))
        at = images + color_bytes + depth_bytes
    return frames, ""


def _inflate(name: str, data: bytes, length: int) -> bytes:
    """Decompress zlib data of known length."""
    stream = zlib.decompressobj()
    try:
        unpacked = stream.decompress(data, length + 1)
    except zlib.error as error:
        raise FrameError(f"{name}: expected a valid zlib stream, got an error ({error})") from error
    if len(unpacked) > length:
        raise FrameError(f"{name}: expected {length} bytes after decompression, got at least {length + 1}")
    if not stream.eof:
        raise FrameError(f"{name}: expected a complete zlib stream, got a truncated stream")
    return unpacked


def _check_length(name: str, found: int, expected: int) -> None:
    if found != expected:
        raise FrameError(f"{name}: expected {expected} bytes, got {found}")
