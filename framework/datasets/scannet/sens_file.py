"""ScanNet's `.sens` files, version 4: a header, then frame after frame with its pose, times and compressed images.

    uint32 version, uint64 n, n bytes: the sensor's name
    float32[64]     four 4x4 matrices: colour intrinsics, colour extrinsics, depth intrinsics, depth extrinsics
    int32[2]        compression of colour (0 raw, 1 PNG, 2 JPEG) and depth (0 raw, 1 zlib, 2 Occipital's)
    uint32[4]       width and height of colour, of depth
    float32         depth units a metre
    uint64          number of frames
    for each frame: float32[16] camera to world, uint64[2] times of colour and depth (microseconds),
                    uint64[2] sizes of colour and depth (bytes), the two
    (IMU readings follow, which are not read)

All little-endian. Such a file has gigabytes: opening it reads the 96 bytes before each frame's images. ScanNet's own
reader, a script and no package, holds all of it in memory.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from framework.data import MOST_PIXELS, Camera, Float64, UInt8, UInt16
from framework.datasets.frames.conventions import COARSEST_DEPTH, FINEST_DEPTH
from framework.datasets.frames.stored_frames import StoredImages
from framework.errors import DataError, FrameError
from framework.files.atomic_write import check_regular
from framework.files.image_files import decode_color
from framework.files.matrix_file import PrintedMatrix

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2  # compression of color; of depth: RAW, or
ZLIB, OCCIPITAL = 1, 2
LONGEST_NAME = 1024  # bytes, of the sensor: "StructureSensor" has 15
MOST_FRAMES = 2**18  # two and a half hours at 30 Hz; ScanNet's longest has some 6,000
START = struct.Struct("<IQ")
MATRIX_BYTES = 64
IMAGES = struct.Struct("<iiIIIIfQ")
FRAME = struct.Struct("<64s4Q")
OVERHEAD = 2**16  # bytes by which a compressed image may be larger than twice the raw one


@dataclass(frozen=True)
class SensHeader:
    """What a file says of all its frames."""

    color_camera: Camera
    depth_camera: Camera
    color_extrinsics: PrintedMatrix  # identity in all that was published, so which way it maps is not known
    depth_extrinsics: PrintedMatrix  # likewise
    color_compression: int  # RAW, PNG or JPEG
    depth_compression: int  # RAW or ZLIB
    depth_scale: float  # units a metre
    frames: int  # number of frames that the file should hold


@dataclass(frozen=True)
class SensFrame:
    """One frame, its images not read yet."""

    path: Path
    header: SensHeader
    number: int
    byte: int  # where its images begin: colour, then depth
    color_bytes: int
    depth_bytes: int
    color_time: int  # microseconds
    depth_time: int  # microseconds
    camera_to_world: PrintedMatrix  # T_world_camera; -inf where the pose is not known

    @property
    def color_name(self) -> str:
        return f"{self.path}, colour of frame {self.number} at byte {self.byte}"

    @property
    def depth_name(self) -> str:
        return f"{self.path}, depth of frame {self.number} at byte {self.byte + self.color_bytes}"

    @property
    def images(self) -> StoredImages:
        """The two images, each in its own camera."""
        return StoredImages(self.color_name, self.depth_name, self.color, self.depth)

    def color(self) -> UInt8:
        """(H, W, 3) RGB in the colour camera. Raises FrameError."""
        data = self._read(self.color_name, self.byte, self.color_bytes)
        if self.header.color_compression != RAW:
            return decode_color(self.color_name, data)
        shape = (*self.header.color_camera.shape, 3)
        _check_length(self.color_name, len(data), shape[0] * shape[1] * 3)
        return np.frombuffer(data, np.uint8).reshape(shape)

    def depth(self) -> UInt16:
        """(H, W) in the depth camera; 0 = no reading. Raises FrameError."""
        data = self._read(self.depth_name, self.byte + self.color_bytes, self.depth_bytes)
        shape = self.header.depth_camera.shape
        length = shape[0] * shape[1] * 2
        if self.header.depth_compression == ZLIB:
            data = _inflate(self.depth_name, data, length)
        _check_length(self.depth_name, len(data), length)
        return np.frombuffer(data, "<u2").reshape(shape).astype(np.uint16, copy=False)

    def _read(self, name: str, byte: int, length: int) -> bytes:
        try:
            with self.path.open("rb") as file:  # of its own: frames are read in several threads
                file.seek(byte)
                data = file.read(length)
        except OSError as error:
            raise FrameError(f"{name} could not be read: {error.strerror or error}") from error
        _check_length(name, len(data), length)
        return data


@dataclass(frozen=True)
class SensFile:
    """What a file holds."""

    header: SensHeader
    frames: tuple[SensFrame, ...]  # those whose images are there, from the first on
    cut: str  # why the others of header.frames are not; "" = all are


def open_sens(path: Path) -> SensFile:
    """The header and where the frames are. Raises DataError, naming the byte, when the header cannot be."""
    check_regular(path)
    try:
        with path.open("rb", buffering=0) as file:
            length = file.seek(0, 2)
            file.seek(0)
            header = _read_header(path, file, length)
            frames, cut = _find_frames(path, file, length, header)
    except OSError as error:
        raise DataError(f"{path} could not be read: {error.strerror or error}") from error
    if not frames:
        raise DataError(f"{path} holds no frame: {cut or 'its header says 0'}")
    return SensFile(header, tuple(frames), cut)


def _read_header(path: Path, file: BinaryIO, length: int) -> SensHeader:
    version, name_bytes = START.unpack(_take(path, file, START.size, length))
    if version != VERSION:
        raise DataError(f"{path}, byte 0: expected version {VERSION} of the .sens format, found {version}")
    if name_bytes > LONGEST_NAME:
        raise DataError(f"{path}, byte 4: the sensor's name has {name_bytes} bytes, more than {LONGEST_NAME}")
    _take(path, file, name_bytes, length)
    matrices = [_take_matrix(path, file, length) for _ in range(4)]
    at = file.tell()
    color_code, depth_code, *sizes, depth_scale, frames = IMAGES.unpack(_take(path, file, IMAGES.size, length))
    for what, width, height in (("colour", *sizes[:2]), ("depth", *sizes[2:])):
        if not 0 < width * height <= MOST_PIXELS:
            raise DataError(f"{path}, byte {at + 8}: {what} images of {width}x{height} px; at most {MOST_PIXELS} px")
    if not COARSEST_DEPTH <= depth_scale <= FINEST_DEPTH:
        raise DataError(
            f"{path}, byte {at + 24}: the depth units a metre must be in [{COARSEST_DEPTH:g}, {FINEST_DEPTH:g}], "
            f"found {depth_scale:g}"
        )
    if frames > MOST_FRAMES or frames * FRAME.size > length:
        raise DataError(f"{path}, byte {at + 28}: {frames} frames cannot be in a file of {length} bytes")
    _check_compressions(path, at, color_code, depth_code)
    color_intrinsics, color_extrinsics, depth_intrinsics, depth_extrinsics = matrices
    return SensHeader(
        color_camera=color_intrinsics.camera(*sizes[:2]),
        depth_camera=depth_intrinsics.camera(*sizes[2:]),
        color_extrinsics=color_extrinsics,
        depth_extrinsics=depth_extrinsics,
        color_compression=color_code,
        depth_compression=depth_code,
        depth_scale=depth_scale,
        frames=frames,
    )


def _take(path: Path, file: BinaryIO, count: int, length: int) -> bytes:
    at = file.tell()
    data = file.read(count)
    if len(data) < count:
        raise DataError(f"{path}, byte {at}: the file ends at byte {length}, within its header")
    return data


def _take_matrix(path: Path, file: BinaryIO, length: int) -> PrintedMatrix:
    at = file.tell()
    return _matrix(f"{path}, byte {at}", _take(path, file, MATRIX_BYTES, length))


def _matrix(where: str, data: bytes) -> PrintedMatrix:
    values: Float64 = np.frombuffer(data, "<f4").reshape(4, 4).astype(np.float64)
    return PrintedMatrix(where, values)


def _check_compressions(path: Path, at: int, color: int, depth: int) -> None:
    if color not in (RAW, PNG, JPEG):
        raise DataError(f"{path}, byte {at}: expected a compression of colour: 0, 1 or 2, found {color}")
    if depth == OCCIPITAL:
        raise DataError(
            f"{path}, byte {at + 4}: depth is compressed by Occipital's own method, which only their library reads; "
            "export the frames with ScanNet's SensReader"
        )
    if depth not in (RAW, ZLIB):
        raise DataError(f"{path}, byte {at + 4}: expected a compression of depth: 0 or 1, found {depth}")


def _find_frames(path: Path, file: BinaryIO, length: int, header: SensHeader) -> tuple[list[SensFrame], str]:
    """The frames whose images are in the file, and why there are no more; "" when these are all."""
    most_color = 2 * 3 * header.color_camera.width * header.color_camera.height + OVERHEAD
    most_depth = 2 * 2 * header.depth_camera.width * header.depth_camera.height + OVERHEAD
    frames: list[SensFrame] = []
    at = file.tell()
    for number in range(header.frames):
        if at + FRAME.size > length:
            return frames, f"byte {at}: the file ends at byte {length}, before frame {number} of {header.frames} does"
        file.seek(at)
        pose, color_time, depth_time, color_bytes, depth_bytes = FRAME.unpack(file.read(FRAME.size))
        images = at + FRAME.size
        if color_bytes > most_color or depth_bytes > most_depth:
            return frames, f"byte {at}: frame {number} claims {color_bytes} bytes of colour and {depth_bytes} of depth"
        if images + color_bytes + depth_bytes > length:
            return frames, f"byte {at}: the file ends at byte {length}, before frame {number} of {header.frames} does"
        frames.append(
            SensFrame(
                path=path,
                header=header,
                number=number,
                byte=images,
                color_bytes=color_bytes,
                depth_bytes=depth_bytes,
                color_time=color_time,
                depth_time=depth_time,
                camera_to_world=_matrix(f"{path}, byte {at}", pose),
            )
        )
        at = images + color_bytes + depth_bytes
    return frames, ""


def _inflate(name: str, data: bytes, length: int) -> bytes:
    """What zlib makes of `data`, of which never more than one byte over `length` is unpacked."""
    stream = zlib.decompressobj()
    try:
        unpacked = stream.decompress(data, length + 1)
    except zlib.error as error:
        raise FrameError(f"{name} could not be decoded: {error}") from error
    if len(unpacked) > length:
        raise FrameError(f"{name} unpacks to more than the {length} bytes of an image")
    if not stream.eof:
        raise FrameError(f"{name} is truncated: its zlib stream does not end")
    return unpacked


def _check_length(name: str, found: int, expected: int) -> None:
    if found != expected:
        raise FrameError(f"{name}: expected {expected} bytes, found {found}")
