"""Import of the iPhone recordings of ScanNet++ (Yeshwanth et al., ICCV 2023; https://github.com/scannetpp/scannetpp).

    iphone/pose_intrinsic_imu.json      for each frame, such as "frame_000000": timestamp, s; intrinsic, 3 x 3, of
                                        color; aligned_pose, 4 x 4, T_world_camera in the frame of the laser scan;
                                        pose, 4 x 4, as tracked by ARKit
    iphone/rgb.mp4                      1920x1440, or the extracted images rgb/frame_000000.jpg
    iphone/depth.bin                    256x192, or the extracted images depth/frame_000000.png: uint16 mm

depth.bin contains either one zlib stream of float32 m for all frames, or for each frame its size (uint32) and an LZ4
block of uint16 mm or a zlib stream of float32 m. The zlib streams have no header (prepare_iphone_data.py in the
toolkit). Poses have OpenCV's camera axes (arkit_pcl.py in the toolkit), and the z axis of the aligned world points up.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Float32, Float64, UInt8
from framework.datasets.calibration.camera_json import number_list, numbers_of, pinhole, read_json_object
from framework.errors import DataError, FrameError, errors_of, import_optional
from framework.files.image_files import read_color, read_uint16
from framework.geometry import nearest_rigid
from framework.importing.phones.stray_scanner import Video
from framework.importing.source import DeviceFrame, Format, Source, meters, readings
from framework.sensors.noise_models import SensorKind

METADATA = "pose_intrinsic_imu.json"
LARGEST_METADATA = 2**30  # bytes; a minute of 60 Hz has about 5 MB
SHAPE = (192, 256)  # (h, w) of depth, px
UINT16_BYTES, FLOAT32_BYTES = (size * SHAPE[0] * SHAPE[1] for size in (2, 4))  # of a depth image
LARGEST_BLOCK = FLOAT32_BYTES + 1000  # bytes; compressed noise is slightly larger than the image
CHUNK = 2**16  # bytes of a stream that are read at once

_load_lz4 = partial(import_optional, "lz4.block", "decompresses the depth of ScanNet++", "phone")
_FRAME = re.compile(r"frame_([0-9]{6})")

ReadDepth = Callable[[int], Float32]  # depth (h, w), m, of a frame number
ReadColor = Callable[[int], UInt8]  # color (H, W, 3), RGB, of a frame number


def iphone(path: Path) -> Path:
    """Return the folder with the recording of the iPhone."""
    return path / "iphone" if (path / "iphone" / METADATA).is_file() else path


def recognized(path: Path) -> bool:
    """Return True if the path is a scene of ScanNet++ with an iPhone recording, or that recording."""
    return (iphone(path) / METADATA).is_file()


def open_source(path: Path) -> Source:
    """Open a recording.

    Raises:
        DataError: A file is missing or invalid.
    """
    folder = iphone(path)
    content = read_json_object(folder / METADATA, LARGEST_METADATA)
    numbers = sorted(int(match[1]) for name in content if (match := _FRAME.fullmatch(name)))
    if not numbers:
        raise DataError(f"{folder / METADATA}: expected keys such as frame_000000, got none in {len(content)} keys")
    color, depth = _color_reader(folder), _depth_reader(folder)
    frames = [partial(_read, folder / METADATA, content, number, color, depth) for number in numbers]
    return Source("ScanNet++ iPhone", frames, len(frames), posed=True, sensor=SensorKind.PHONE_LIDAR)


def _read(path: Path, content: Mapping[str, Any], number: int, color: ReadColor, depth: ReadDepth) -> DeviceFrame:
    name = f"frame_{number:06d}"
    where, frame = f"{path}: {name}", content[name]
    if not isinstance(frame, dict):
        raise FrameError(f"{where}: expected a JSON object, got {frame!r:.60}")
    [timestamp] = numbers_of(where, frame, "timestamp")
    K = _matrix(f"{where}: intrinsic", frame.get("intrinsic"), 3)
    matrix = _matrix(f"{where}: aligned_pose", frame.get("aligned_pose"), 4)
    with errors_of(f"{where}: aligned_pose"):
        T_world_camera = nearest_rigid(matrix)
    image = color(number)
    height, width = image.shape[:2]
    return DeviceFrame(
        name=where,
        timestamp=timestamp,
        camera=pinhole(where, width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
        color=image,
        depth=depth(number),
        T_world_camera=T_world_camera,
        up=np.array(T_world_camera[2, :3]),
    )


def _matrix(where: str, rows: Any, size: int) -> Float64:
    if not isinstance(rows, list) or len(rows) != size:
        raise FrameError(f"{where}: expected {size} lists of {size} numbers, got {rows!r:.60}")
    return np.array([number_list(where, row, size) for row in rows])


def _color_reader(folder: Path) -> ReadColor:
    """Return the reader of color images. Extracted images are preferred to the video."""
    if (folder / "rgb").is_dir():
        return lambda number: read_color(folder / f"rgb/frame_{number:06d}.jpg")
    return Video(folder / "rgb.mp4").frame


def _depth_reader(folder: Path) -> ReadDepth:
    """Return the reader of depth images. Extracted images are preferred to depth.bin."""
    if (folder / "depth").is_dir():
        return lambda number: meters(read_uint16(folder / f"depth/frame_{number:06d}.png"))
    path = folder / "depth.bin"
    if not path.is_file():
        raise DataError(f"{path}: expected depth.bin or depth/, got neither; download the iPhone's depth")
    blocks = _blocks(path)
    return DepthStream(path).depth if blocks is None else partial(_block_depth, path, blocks)


def _blocks(path: Path) -> Sequence[tuple[int, int]] | None:
    """Return the position and size of the compressed data of each frame; None = the file is a single stream."""
    blocks, start, end = [], 0, path.stat().st_size
    with path.open("rb") as file:
        while start < end:
            file.seek(start)
            size = int.from_bytes(file.read(4), "little")
            start += 4
            if not 0 < size <= min(LARGEST_BLOCK, end - start):
                return None
            blocks.append((start, size))
            start += size
    return blocks or None


def _block_depth(path: Path, blocks: Sequence[tuple[int, int]], number: int) -> Float32:
    where = f"{path}: frame {number}"
    if number >= len(blocks):
        raise FrameError(f"{where}: expected a frame number of at most {len(blocks) - 1}, got {number}")
    with path.open("rb") as file:
        file.seek(blocks[number][0])
        packed = file.read(blocks[number][1])
    lz4 = _load_lz4()
    try:  # in this order, as in the toolkit
        return meters(np.frombuffer(lz4.decompress(packed, UINT16_BYTES), "<u2").reshape(SHAPE))
    except (lz4.LZ4BlockError, ValueError):
        pass
    try:
        raw = zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, FLOAT32_BYTES)
        return readings(np.frombuffer(raw, "<f4").reshape(SHAPE))
    except (zlib.error, ValueError) as error:
        expected = f"expected an LZ4 block of {UINT16_BYTES} bytes or a zlib stream of {FLOAT32_BYTES} bytes"
        raise FrameError(f"{where}: {expected}, got damaged data") from error


class DepthStream:
    """Reader of depth images in a single zlib stream, in ascending order."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, path.open("rb")
        self._stream = zlib.decompressobj(-zlib.MAX_WBITS)
        self._next, self._raw = 0, b""

    def depth(self, number: int) -> Float32:
        """Return the depth (h, w), m, of a frame.

        Args:
            number: The number of the frame, larger than that of the last call.

        Raises:
            FrameError: The stream is damaged or ends before the frame, or the frame was read before.
        """
        where = f"{self._path}: frame {number}"
        if number < self._next:
            raise FrameError(f"{where}: expected increasing frame numbers, got {number} after {self._next - 1}")
        while self._next <= number:
            try:
                self._raw = self._frame()
            except zlib.error as error:
                raise FrameError(f"{where}: expected a zlib stream, got damaged data") from error
            if len(self._raw) != FLOAT32_BYTES:
                raise FrameError(f"{where}: expected {FLOAT32_BYTES} bytes, got the end of the stream")
            self._next += 1
        return readings(np.frombuffer(self._raw, "<f4").reshape(SHAPE))

    def _frame(self) -> bytes:
        """Return the bytes of the next frame, or fewer bytes at the end of the stream."""
        raw = b""
        while len(raw) < FLOAT32_BYTES and (packed := self._stream.unconsumed_tail or self._file.read(CHUNK)):
            raw += self._stream.decompress(packed, FLOAT32_BYTES - len(raw))
        return raw


NEEDS = f"a scene of ScanNet++ with iphone/{METADATA}, rgb.mp4 or rgb/, and depth.bin or depth/"
FORMAT = Format("scannetpp_iphone", NEEDS, recognized, open_source)
