"""Import of Record3D recordings (https://record3d.app): "EXR + RGB" exports and .r3d files.

    metadata.json           w, h: size of color, px; dw, dh: size of depth, px; K: intrinsics of color, 3 x 3,
                            column-major; fps; poses: [qx, qy, qz, qw, x, y, z] per frame; in newer versions
                            frameTimestamps, s, and perFrameIntrinsicCoeffs: [fx, fy, cx, cy] per frame
    rgb/0.jpg, depth/0.exr  8-bit color; depth in m, as half or single floats in the single channel R

An .r3d file is a zip archive of metadata (the same JSON), rgbd/0.jpg, rgbd/0.depth (float32, m) and rgbd/0.conf.
Confidence (uint8, 0 to 2) requires a LiDAR. Depth and confidence are compressed with LZFSE.

Images are upright in both formats. Poses are T_world_camera of the upright camera in ARKit's axes. In older versions,
the first pose is the identity, and the up direction is unknown. Newer versions store `arframe.camera.transform`
(marek-simonik/record3d, issues 27 and 64). The up direction is therefore known if the first pose is rotated.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import MAX_PIXELS, Camera, Float32, Float64, UInt8
from framework.datasets.calibration.camera_json import number_list, numbers_of, pinhole, read_json_object
from framework.errors import DataError, FrameError, import_optional, in_one_line
from framework.files.atomic_write import MAX_TEXT, read_bytes
from framework.files.image_files import LARGEST_FILE, decode_color, read_color
from framework.files.json_file import parse_json
from framework.files.number_lines import SHOWN
from framework.files.tum_trajectory import QUATERNION_TOLERANCE
from framework.importing.source import DeviceFrame, Format, Source, arkit_pose, arkit_up, readings, warn_of_zeros
from framework.sensors.noise_models import SensorKind

CHANNEL = "R"  # of the EXR files
LZFSE_BLOCK = b"bvx"  # first bytes of each block of compressed data
BYTES_A_BLOCK = 20_000  # minimum block size; blocks of data without repetitions have 40,000 bytes
# maximum sine of half the rotation angle of an unrotated pose; a hand-held phone is never aligned this exactly
UNTURNED = 1e-3
MAX_BLOCKS = 8  # number of additional blocks; limited, because a block may decompress to 27 MB

_load_openexr = partial(import_optional, "OpenEXR", "reads Record3D's depth", "phone")
_load_lzfse = partial(import_optional, "lzfse", "unpacks Record3D's .r3d files", "phone")


def open_folder(path: Path) -> Source:
    """Open an exported folder."""
    _load_openexr()
    return _source(path / "metadata.json", read_json_object(path / "metadata.json"), ExrFolder(path))


def open_file(path: Path) -> Source:
    """Open an .r3d file."""
    _load_lzfse()
    files = R3dFile(path)
    where = f"{path}: metadata"
    content = parse_json(where, files.read("metadata", MAX_TEXT))
    if not isinstance(content, dict):
        raise DataError(f"{where}: expected a JSON object, got {type(content).__name__}")
    return _source(where, content, files)


@dataclass(frozen=True)
class ExrFolder:
    """Images of an exported folder by frame number."""

    folder: Path

    def color(self, number: int) -> UInt8:
        """Read the color image (H, W, 3), RGB."""
        return read_color(self.folder / f"rgb/{number}.jpg")

    def depth(self, number: int, shape: tuple[int, int]) -> Float32:
        """Read the depth image (h, w), m, 0 = no reading."""
        path = self.folder / f"depth/{number}.exr"
        return readings(_read_exr(path, read_bytes(path, LARGEST_FILE), shape))

    def confidence(self, number: int, shape: tuple[int, int]) -> UInt8 | None:
        """Read the confidence (h, w) of depth, from 0 to 2, or return None if unknown."""
        return None

    def name(self, number: int) -> str:
        """Return the depth file of a frame, for messages."""
        return str(self.folder / f"depth/{number}.exr")


class R3dFile:
    """Images of an .r3d file by frame number."""

    def __init__(self, path: Path) -> None:
        """Open an .r3d file.

        Raises:
            DataError: The file is not a zip archive.
        """
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(f"{path}: expected a zip archive, got an error ({in_one_line(error)[:SHOWN]})") from error
        self._members = set(self._zip.namelist())

    def color(self, number: int) -> UInt8:
        name = f"rgbd/{number}.jpg"
        return decode_color(f"{self.path}: {name}", self.read(name, LARGEST_FILE))

    def depth(self, number: int, shape: tuple[int, int]) -> Float32:
        return readings(self._unpacked(f"rgbd/{number}.depth", "<f4", shape).astype(np.float32))

    def confidence(self, number: int, shape: tuple[int, int]) -> UInt8 | None:
        name = f"rgbd/{number}.conf"
        return np.asarray(self._unpacked(name, "u1", shape), np.uint8) if name in self._members else None

    def name(self, number: int) -> str:
        return f"{self.path}: rgbd/{number}.depth"

    def read(self, name: str, most: int) -> bytes:
        """Read an archive member.

        Raises:
            DataError: The member is unreadable or larger than `most` bytes.
        """
        try:
            info = self._zip.getinfo(name)
            if info.file_size > most:
                raise DataError(f"{self.path}: {name}: expected at most {most} bytes, got {info.file_size}")
            return self._zip.read(info)
        except KeyError as error:
            raise FrameError(f"{self.path}: expected {name}, got no such member") from error
        except (OSError, zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, ValueError, RuntimeError) as error:
            if isinstance(error, NotImplementedError):
                kind = self._zip.getinfo(name).compress_type
                raise FrameError(f"{self.path}: {name}: expected a supported compression, got type {kind}") from error
            reason = in_one_line(error)[:SHOWN]
            raise FrameError(f"{self.path}: {name}: expected a readable member, got an error ({reason})") from error

    def _unpacked(self, name: str, dtype: str, shape: tuple[int, int]) -> np.typing.NDArray[np.generic]:
        size = math.prod(shape) * np.dtype(dtype).itemsize
        packed = self.read(name, 2 * size + 1000)
        blocks, most = packed.count(LZFSE_BLOCK), MAX_BLOCKS + size // BYTES_A_BLOCK
        if blocks > most:
            raise FrameError(
                f"{self.path}: {name}: expected at most {most} LZFSE blocks for {size} bytes, got {blocks}"
            )
        lzfse = _load_lzfse()
        try:
            raw = lzfse.decompress(packed)
        except (lzfse.error, MemoryError) as error:
            reason = in_one_line(error)[:SHOWN]
            raise FrameError(f"{self.path}: {name}: expected LZFSE data, got an error ({reason})") from error
        if len(raw) != size:
            expected = f"expected {size} bytes for {shape[1]}x{shape[0]} px"
            raise FrameError(f"{self.path}: {name}: {expected}, got {len(raw)}")
        return np.frombuffer(raw, dtype).reshape(shape)


def _source(where: Path | str, content: Mapping[str, Any], files: ExrFolder | R3dFile) -> Source:
    poses = content.get("poses")
    if not isinstance(poses, list) or not poses:
        raise DataError(f"{where}: poses: expected a list of poses, got {poses!r:.60}")
    size = numbers_of(where, content, "w", "h")
    cameras = [pinhole(where, *size, *of_frame) for of_frame in _intrinsics(where, content, len(poses))]
    shape = _depth_shape(where, content, cameras[0])
    times = _times(where, content, len(poses))
    knows_up = _is_turned(next((pose for pose in poses if not _is_unknown(pose)), None))

    def read(k: int) -> DeviceFrame:
        T_world_camera = _pose(f"{where}: pose {k}", poses[k])
        return DeviceFrame(
            name=files.name(k),
            timestamp=times[k],
            camera=cameras[k],
            color=files.color(k),
            depth=files.depth(k, shape),
            confidence=files.confidence(k, shape),
            T_world_camera=T_world_camera,
            up=arkit_up(T_world_camera) if knows_up and T_world_camera is not None else None,
        )

    posed = not all(_is_unknown(pose) for pose in poses)
    if not posed:
        warn_of_zeros(f"{where}: poses")
    frames = [partial(read, k) for k in range(len(poses))]
    return Source("Record3D", frames, len(poses), posed=posed, sensor=SensorKind.PHONE_LIDAR)


def _is_unknown(pose: Any) -> bool:
    """Return True if a stored pose contains only zeros."""
    return isinstance(pose, list) and len(pose) == 7 and all(value == 0 for value in pose)


def _pose(where: str, values: Any) -> Float64 | None:
    """Return T_world_camera (4, 4), or None if it is unknown."""
    if _is_unknown(values):
        return None
    quat_xyzw, position = np.split(np.array(number_list(where, values, 7)), [4])
    length = float(np.linalg.norm(quat_xyzw))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise DataError(f"{where}: expected a quaternion qx qy qz qw of length 1, got {length:.4g}")
    T_world_arkit = np.eye(4)
    T_world_arkit[:3, :3] = Rotation.from_quat(quat_xyzw).as_matrix()
    T_world_arkit[:3, 3] = position
    return arkit_pose(where, T_world_arkit)


def _is_turned(pose: Any) -> bool:
    """Return True if a stored pose is valid and its rotation is not the identity."""
    try:
        quat_xyzw = number_list("pose", pose, 7)[:4]
    except DataError:
        return False
    return bool(np.linalg.norm(quat_xyzw[:3]) >= UNTURNED)


def _intrinsics(where: Path | str, content: Mapping[str, Any], count: int) -> list[tuple[float, ...]]:
    """Return fx, fy, cx, cy, px, of each color image."""
    own = content.get("perFrameIntrinsicCoeffs")
    if isinstance(own, list) and len(own) == count:
        return [tuple(number_list(f"{where}: perFrameIntrinsicCoeffs", values, 4)) for values in own]
    fx, _, _, _, fy, _, cx, cy, _ = number_list(f"{where}: K", content.get("K"), 9)
    return [(fx, fy, cx, cy)] * count


def _times(where: Path | str, content: Mapping[str, Any], count: int) -> list[float]:
    """Return the timestamp of each frame, s."""
    if "frameTimestamps" in content:
        return number_list(f"{where}: frameTimestamps", content.get("frameTimestamps"), count)
    [rate] = numbers_of(where, content, "fps")
    if not rate > 0:
        raise DataError(f"{where}: fps: expected a value > 0 Hz, got {rate:g}")
    return [k / rate for k in range(count)]


def _depth_shape(where: Path | str, content: Mapping[str, Any], camera: Camera) -> tuple[int, int]:
    """Return the size (h, w) of the depth images, px."""
    if "dw" not in content:  # older versions; depth has the size of color
        return camera.shape
    width, height = numbers_of(where, content, "dw", "dh")
    return pinhole(where, width, height, camera.fx, camera.fy, 0, 0).shape


def _read_exr(path: Path, data: bytes, shape: tuple[int, int]) -> np.typing.NDArray[np.floating]:
    """Read a depth image (h, w), m, from an EXR file."""
    OpenEXR = _load_openexr()
    try:  # the header is checked first, because it determines the required memory
        header = OpenEXR.File(io.BytesIO(data), header_only=True).header()
        low, high = header["dataWindow"]
        found = tuple(int(n) for n in (high - low + 1)[::-1])
        names = [channel.name for channel in header["channels"]]
    except Exception as error:  # OpenEXR has no common base exception
        raise FrameError(f"{path}: expected an EXR file, got an error ({in_one_line(error)[:SHOWN]})") from error
    if found != shape or names != [CHANNEL] or math.prod(shape) > MAX_PIXELS:
        expected = f"expected {shape[1]}x{shape[0]} px with the channel {CHANNEL}"
        raise FrameError(f"{path}: {expected}, got {found[1]}x{found[0]} px with {', '.join(names)[:60]}")
    try:
        image = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()[CHANNEL].pixels
    except Exception as error:
        raise FrameError(f"{path}: expected a decodable image, got an error ({in_one_line(error)[:SHOWN]})") from error
    if image.shape != shape or image.dtype not in (np.float16, np.float32):
        raise FrameError(f"{path}: expected float16 or float32, got {image.dtype}")
    return np.asarray(image, np.float32)


def _is_export(path: Path) -> bool:
    return (path / "metadata.json").is_file() and (path / "rgb").is_dir() and (path / "depth").is_dir()


def _is_r3d(path: Path) -> bool:
    return path.suffix.lower() == ".r3d" and path.is_file()


EXPORT = 'a folder with metadata.json, rgb/ and depth/, exported from Record3D as "EXR + RGB"'
FOLDER_FORMAT = Format("record3d_exr", EXPORT, _is_export, open_folder)
FILE_FORMAT = Format("record3d", "an .r3d file exported from Record3D", _is_r3d, open_file)
