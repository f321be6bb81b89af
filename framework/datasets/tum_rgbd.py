"""TUM RGB-D dataset (Sturm et al., IROS 2012).

Kinect videos with motion-capture poses:

    rgb.txt, depth.txt      one line per image: `timestamp filename`, timestamp in s; `#` begins a comment
    rgb/, depth/            8-bit color; uint16 depth along z, registered to color, 5000 units per m; 0 = no reading
    groundtruth.txt         optional; TUM format, T_world_camera of the color camera, about 100 poses per second
    camera.json             for other recordings in this layout: intrinsics, depth scale and distortion, with the
                            same keys as in an RGB-D folder; read with intrinsics=AUTO. Other files with intrinsics
                            (`own_camera.py`), such as the calibration.txt of ETH3D, are also read.

The published depth correction factors are already applied. The images of freiburg1 and freiburg2 have a lens distortion
of 5 px or more in half of the pixels, which is corrected on reading. The images of freiburg3 were published
undistorted.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float64
from framework.datasets.calibration.camera_json import CAMERA_KEYS, StoredCamera
from framework.datasets.calibration.own_camera import CAMERA_JSON, OwnCamera, own_camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.sequence_reader import Contents, RecordedFrame, Recording, StoredImages
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import path_exists
from framework.files.number_lines import SHOWN, read_lines
from framework.files.tum_trajectory import TumLine, read_tum_lines
from framework.geometry import interpolate

DEPTH_SCALE = 5000.0  # units per meter
LONGEST_NAME = 255  # maximum number of characters of a file name

log = logging.getLogger(__name__)


class Intrinsics(Enum):
    """Published calibration of the color camera."""

    AUTO = "from camera.json or the folder name"
    FREIBURG1 = "freiburg1"
    FREIBURG2 = "freiburg2"
    FREIBURG3 = "freiburg3"
    ROS_DEFAULT = "ROS default"


# https://vision.in.tum.de/data/datasets/rgbd-dataset/file_formats, "Calibration of the color camera"
_LENS_1 = Distortion(k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633)
_LENS_2 = Distortion(k1=0.2312, k2=-0.7849, p1=-0.0033, p2=-0.0001, k3=0.9172)
PUBLISHED: Mapping[Intrinsics, StoredCamera] = {
    Intrinsics.FREIBURG1: StoredCamera(Camera(640, 480, 517.3, 516.5, 318.6, 255.3), DEPTH_SCALE, _LENS_1),
    Intrinsics.FREIBURG2: StoredCamera(Camera(640, 480, 520.9, 521.0, 325.1, 249.7), DEPTH_SCALE, _LENS_2),
    Intrinsics.FREIBURG3: StoredCamera(Camera(640, 480, 535.4, 539.2, 320.1, 247.6), DEPTH_SCALE, None),
    Intrinsics.ROS_DEFAULT: StoredCamera(Camera(640, 480, 525.0, 525.0, 319.5, 239.5), DEPTH_SCALE, None),
}


@dataclass
class TumRgbd(Recording):
    """A sequence of TUM RGB-D, or another recording in the same layout.

    Color and depth images are associated by time. The closest pairs are matched first, and each image is used once. The
    ground-truth pose is interpolated at the time of the color image. It is unknown if no stored pose is within
    `max_time_difference`.
    """

    intrinsics: Intrinsics = Intrinsics.AUTO  # intrinsics of the color camera
    # maximum time difference between color and depth, and between color and ground-truth pose, s, in (0, 1]
    max_time_difference: float = 0.02
    undistort: bool = True  # True = correct the published lens distortion; False = use the images as stored

    def __post_init__(self) -> None:
        difference = self.max_time_difference
        require(0 < difference <= 1, "dataset.max_time_difference", difference, "a value in (0, 1] s")
        super().__post_init__()

    def open(self) -> Contents:
        color, depth = _read_list(self.folder / "rgb.txt"), _read_list(self.folder / "depth.txt")
        own = self._stored_camera(color)
        camera, depth_scale, distortion, sensor = own.stored
        tolerance = self.max_time_difference / self.time_unit
        color_times, depth_times = ([image.timestamp for image in images] for images in (color, depth))
        pairs = associate(color_times, depth_times, tolerance)
        if not pairs:
            raise DataError(
                f"{self.folder}: expected images of rgb.txt and depth.txt within dataset.max_time_difference "
                f"({self.max_time_difference:g} s) of each other, got none"
            )
        if len(pairs) < len(color):
            log.info(
                "%s: %d of %d color images have no depth image within dataset.max_time_difference=%g s",
                self.name,
                len(color) - len(pairs),
                len(color),
                self.max_time_difference,
            )
        path = self.folder / "groundtruth.txt"
        truth = Trajectory.of(path, read_tum_lines(path) if path_exists(path) else [], tolerance)
        frames = []
        for i, j in pairs:
            images, time = own.images(StoredImages.of_files(color[i].path, depth[j].path)), color[i].timestamp
            recorded = RecordedFrame.posed(images, time, partial(truth.at, time))
            frames.append(replace(recorded, color_timestamp=time, depth_timestamp=depth[j].timestamp))
        return Contents(camera, own.source, depth_scale, frames, distortion if self.undistort else None, sensor)

    def _stored_camera(self, color: Sequence[ListedImage]) -> OwnCamera:
        """Return the camera and the file or parameter that defines it."""
        intrinsics = self.intrinsics
        if intrinsics is Intrinsics.AUTO:
            own = own_camera(self.name, self.folder, [image.path for image in color], DEPTH_SCALE)
            if own is not None:
                return own
            named = re.search(r"freiburg[123]", self.name)
            if not named:
                raise ConfigError(
                    f"dataset.intrinsics: expected freiburg1, freiburg2 or freiburg3 in the folder's name, got "
                    f"{self.name}; set FREIBURG1, FREIBURG2, FREIBURG3 or ROS_DEFAULT, or write "
                    f"{self.folder / CAMERA_JSON} with {', '.join(CAMERA_KEYS)}"
                )
            intrinsics = Intrinsics(named[0])
        log.info("%s: published camera %s of TUM RGB-D", self.name, intrinsics.name)
        return OwnCamera(PUBLISHED[intrinsics], f"dataset.intrinsics={intrinsics.name}")


@dataclass(frozen=True)
class ListedImage:
    """A line of rgb.txt or depth.txt."""

    timestamp: float  # s
    path: Path


Timed = TypeVar("Timed", ListedImage, TumLine)


@dataclass(frozen=True)
class Trajectory:
    """Stored poses, interpolated in time."""

    lines: Sequence[TumLine]  # in order of time; poses may be invalid
    timestamps: Float64  # (L,) s, of the lines
    max_time_difference: float  # s, maximum time difference to the nearest pose

    @classmethod
    def of(cls, path: Path, lines: Sequence[TumLine], max_difference: float) -> Trajectory:
        """Return the trajectory that consists of the lines of a file.

        If a timestamp is repeated, only its first line is used. Poses of zeros count as unknown.
        """
        zeros = sum(line.is_zero for line in lines)
        if zeros:
            log.warning("%s: %d of %d poses contain only zeros and count as unknown", path, zeros, len(lines))
            lines = [line for line in lines if not line.is_zero]
        ordered = sorted(_first_of_each(path, lines, "poses"), key=lambda line: line.timestamp)
        return cls(ordered, np.array([line.timestamp for line in ordered]), max_difference)

    def at(self, timestamp: float) -> Float64 | None:
        """Return the interpolated pose T_world_camera (4, 4) at a time in s, or None if unknown.

        Raises:
            DataError: A stored pose is invalid.
        """
        after = int(np.searchsorted(self.timestamps, timestamp, side="right"))
        around = range(max(after - 1, 0), min(after + 1, len(self.lines)))
        if not any(abs(self.timestamps[k] - timestamp) <= self.max_time_difference for k in around):
            return None
        a, b = self.lines[around[0]], self.lines[around[-1]]
        if a is b or a.timestamp == timestamp:
            return a.pose()
        return interpolate(a.pose(), b.pose(), (timestamp - a.timestamp) / (b.timestamp - a.timestamp))


def associate(first: Sequence[float], second: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """Return index pairs of timestamps that differ by at most `max_difference`.

    The timestamps are in s. The closest pairs are matched first, as in associate.py of the benchmark.
    """
    order = np.argsort(second, kind="stable")
    times = np.asarray(second, np.float64)[order]
    lows = np.searchsorted(times, np.subtract(first, max_difference))
    highs = np.searchsorted(times, np.add(first, max_difference), side="right")
    candidates = sorted(
        (abs(first[i] - times[k]), i, int(order[k]))
        for i, (low, high) in enumerate(zip(lows, highs, strict=True))
        for k in range(low, high)
    )
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in candidates:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    return sorted(partner.items(), key=lambda pair: first[pair[0]])


def _first_of_each(path: Path, items: Sequence[Timed], name: str) -> list[Timed]:
    """Return the first item with each timestamp."""
    at: dict[float, Timed] = {}  # association is quadratic in the number of duplicates
    for item in items:
        at.setdefault(item.timestamp, item)
    if len(at) < len(items):
        repeated = len(items) - len(at)
        log.warning(
            "%s: expected unique timestamps, got repeated ones; skipped %d %s that repeat a timestamp",
            path,
            repeated,
            name,
        )
    return list(at.values())


def _read_list(path: Path) -> list[ListedImage]:
    """Read a list of images, with lines of `timestamp filename`."""
    lines = read_lines(path, missing="expected lines of `timestamp filename`, got no such file")
    numbered = [(n, line.strip()) for n, line in enumerate(lines, start=1)]
    images = [_listed(path, n, line) for n, line in numbered if line and not line.startswith("#")]
    if not images:
        raise DataError(f"{path}: expected a list of images, got none")
    return _first_of_each(path, images, "images")


def _listed(path: Path, number: int, line: str) -> ListedImage:
    time, *names = line.split(maxsplit=1)
    try:
        timestamp = float(time)
    except ValueError:
        timestamp = math.nan
    if not names or not math.isfinite(timestamp) or not names[0].isprintable() or len(names[0]) > LONGEST_NAME:
        raise DataError(f"{path}, line {number}: expected `timestamp filename`, got {line[:SHOWN]!r}")
    return ListedImage(timestamp, path.parent / names[0])
