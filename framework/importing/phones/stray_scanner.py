"""Import of recordings from Stray Scanner (https://github.com/strayrobots/scanner, docs/format.md).

    rgb.mp4                 HEVC, 1920x1440, in sensor orientation; appears rotated if the phone was held upright
    depth/000000.png        uint16 mm, 256x192, one image per video frame
    confidence/000000.png   uint8 0 to 2, from ARKit
    camera_matrix.csv       3 x 3 intrinsics of the video
    odometry.csv            timestamp, frame, x, y, z, qx, qy, qz, qw; in newer versions also fx, fy, cx, cy

The app records on iPhones and iPads with LiDAR. It rotates ARKit's camera about its x axis before writing (q_WA * q_AC
in OdometryEncoder). Poses are therefore T_world_camera in OpenCV's axes. The accelerometer data of a real recording
confirm this.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from framework.data import MAX_PIXELS, Camera, UInt8
from framework.datasets.calibration.camera_json import pinhole
from framework.errors import DataError, FrameError
from framework.files.atomic_write import check_regular
from framework.files.image_files import read_uint8, read_uint16
from framework.files.number_lines import SHOWN, numbers, read_lines
from framework.files.tum_trajectory import TumLine
from framework.importing.source import DeviceFrame, Format, Source, arkit_up, meters, warn_of_zeros
from framework.sensors.noise_models import SensorKind

POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")  # first columns of odometry.csv
INTRINSICS = ("fx", "fy", "cx", "cy")  # next columns, in newer versions
# bytes that identify MP4 and QuickTime files; for other file types, FFmpeg might open further files
KIND_AT, KIND = 4, b"ftyp"
QUIET = "-8"  # FFmpeg's AV_LOG_QUIET; damage is reported by DataError instead
LAST_FRAME = 10**6 - 1  # largest frame number of six digits


@dataclass(frozen=True)
class OdometryRow:
    """A line of odometry.csv."""

    line: TumLine
    frame: int  # frame number of the images
    camera: Camera  # of the video in this frame


def recognized(path: Path) -> bool:
    """Return True if the path is a recording of Stray Scanner."""
    return (path / "odometry.csv").is_file() and (path / "camera_matrix.csv").is_file()


def open_source(path: Path) -> Source:
    """Open a recording.

    Raises:
        DataError: A file is missing or invalid.
    """
    video = Video(path / "rgb.mp4")
    rows = _read_odometry(path / "odometry.csv", _read_camera(path / "camera_matrix.csv", video))
    confident = (path / "confidence").is_dir()
    frames = [partial(_read, path, row, video, confident) for row in rows]
    posed = not rows or not all(isinstance(row, OdometryRow) and row.line.is_zero for row in rows)
    if not posed:
        warn_of_zeros(path / "odometry.csv")
    return Source("Stray Scanner", frames, len(frames), posed=posed, sensor=SensorKind.PHONE_LIDAR)


def _read(folder: Path, row: OdometryRow | DataError, video: Video, confident: bool) -> DeviceFrame:
    if isinstance(row, DataError):
        raise row
    name, T_world_camera = f"{row.frame:06d}.png", None if row.line.is_zero else row.line.pose()
    return DeviceFrame(
        name=folder / "depth" / name,
        timestamp=row.line.timestamp,
        camera=row.camera,
        color=video.frame(row.frame),
        depth=meters(read_uint16(folder / "depth" / name)),
        confidence=read_uint8(folder / "confidence" / name) if confident else None,
        T_world_camera=T_world_camera,
        up=None if T_world_camera is None else arkit_up(T_world_camera),
    )


def _read_odometry(path: Path, camera: Camera) -> list[OdometryRow | DataError]:
    """Return the odometry of each frame, or the error of an invalid line.

    `camera` is used for lines without intrinsics.
    """
    lines = read_lines(path)
    header = [word.strip() for word in lines[0].split(",")] if lines else []
    if tuple(header[: len(POSE)]) != POSE:
        raise DataError(f"{path}, line 1: expected columns {', '.join(POSE)}, got {', '.join(header)[:100]!r}")
    has_intrinsics = tuple(header[len(POSE) : len(POSE) + len(INTRINSICS)]) == INTRINSICS
    last = len(POSE) + len(INTRINSICS) if has_intrinsics else len(POSE)
    numbered = [(n, line.split(",")[:last]) for n, line in enumerate(lines[1:], start=2) if line.strip()]
    return [_row_or_error(path, n, words, camera) for n, words in numbered]


def _row_or_error(path: Path, number: int, words: list[str], camera: Camera) -> OdometryRow | DataError:
    where = f"{path}, line {number}"
    try:
        timestamp, frame, *pose = numbers(where, words[: len(POSE)], len(POSE), ", ".join(POSE))
        if not 0 <= frame <= LAST_FRAME or frame != int(frame):
            expected = f"expected an integer from 0 to {LAST_FRAME}"
            raise DataError(f"{where}: frame: {expected}, got {words[1].strip()[:SHOWN]!r}")
        own = [word for word in words[len(POSE) :] if word.strip()]
        if own:
            values = numbers(where, own, len(INTRINSICS), ", ".join(INTRINSICS))
            camera = pinhole(where, camera.width, camera.height, *values)
    except DataError as error:
        return error
    return OdometryRow(TumLine(path, number, timestamp, tuple(pose[:3]), tuple(pose[3:])), int(frame), camera)


def _read_camera(path: Path, video: Video) -> Camera:
    lines = [line for line in read_lines(path) if line.strip()]
    if len(lines) != 3:
        raise DataError(f"{path}: expected 3 lines of 3 numbers, got {len(lines)} lines")
    (fx, _, cx), (_, fy, cy), _ = (
        numbers(f"{path}, line {n}", line.split(","), 3) for n, line in enumerate(lines, start=1)
    )
    return pinhole(path, video.width, video.height, fx, fy, cx, cy)


class Video:
    """Reader of video frames in sensor orientation."""

    def __init__(self, path: Path) -> None:
        """Open a video.

        Raises:
            DataError: The file cannot be decoded.
        """
        check_regular(path)
        with path.open("rb") as file:
            if not (start := file.read(KIND_AT + len(KIND))).endswith(KIND):
                raise DataError(f"{path}: expected an MP4 or QuickTime file, got a file that begins with {start!r}")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", QUIET)
        self.path = path
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._capture = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(before)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # ignores the rotation in the metadata
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))  # px
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))  # px
        if not self._capture.isOpened() or not 0 < self.width * self.height <= MAX_PIXELS:
            raise DataError(
                f"{path}: expected a video in a codec that OpenCV supports, got an undecodable file; export it again"
            )
        self._next = 0

    def frame(self, number: int) -> UInt8:
        """Return a frame (H, W, 3), RGB.

        Frames must be read in ascending order.

        Args:
            number: The index of the frame, from 0.

        Raises:
            FrameError: The frame cannot be decoded, or it is before the last frame that was read.
        """
        if number < self._next - 1:
            raise FrameError(f"{self.path}: expected increasing frame numbers, got {number} after {self._next - 1}")
        while self._next <= number:
            if not self._capture.grab():
                raise FrameError(f"{self.path}: expected frame {number}, got the end of the readable video")
            self._next += 1
        decoded, image = self._capture.retrieve()
        if not decoded:
            raise FrameError(f"{self.path}: frame {number}: expected a decodable image, got none")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


NEEDS = "a folder with odometry.csv, camera_matrix.csv, rgb.mp4 and depth/"
FORMAT = Format("stray_scanner", NEEDS, recognized, open_source)
