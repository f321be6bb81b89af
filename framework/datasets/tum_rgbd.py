"""TUM RGB-D (Sturm et al., IROS 2012): Kinect videos with poses from motion capture.

    rgb.txt, depth.txt      a line an image, `timestamp filename`, s; `#` begins a comment
    rgb/, depth/            8-bit colour and uint16 depth along z, registered to colour, 5000 units a metre; 0 = none
    groundtruth.txt         optional; TUM format, T_world_camera of the colour camera, about 100 poses a second
    camera.json             of recordings of one's own in this layout: intrinsics, depth scale and distortion, with the
                            same keys as in an RGB-D folder; read where the folder's name has no freiburg in it

The published correction factors of depth are in the images already. Colour and depth of freiburg1 and freiburg2 have
the lens distortion of the colour camera, by which half of the pixels are off by 5 px or more, the corners by 37 and 27
px; both are undistorted when read. Measured on the first 300 frames of freiburg1_rpy with `voxel_hashing_icp` at 1 cm
and a gate that lets all frames pass: an ATE of 26.7 mm, without it 37.4 mm, with colour alone undistorted 37.5 mm; with
`pycolmap_pnp` 35 and 43 mm. freiburg3's images were undistorted when they were published.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from framework.config.validation import require
from framework.data import Camera, Float64
from framework.datasets.calibration.camera_json import CAMERA_KEYS, StoredCamera, read_camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.sequence_reader import Contents, Recording
from framework.datasets.frames.stored_frames import RecordedFrame, StoredImages
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import is_there
from framework.files.number_lines import SHOWN, read_lines
from framework.files.tum_trajectory import TumLine, read_tum_lines
from framework.geometry import interpolate

DEPTH_SCALE = 5000.0  # units a metre
LONGEST_NAME = 255  # characters of an image's

log = logging.getLogger(__name__)


class Intrinsics(Enum):
    """Which of the published calibrations of the colour camera holds."""

    AUTO = "by the folder's name, or by its camera.json"
    FREIBURG1 = "freiburg1"
    FREIBURG2 = "freiburg2"
    FREIBURG3 = "freiburg3"
    ROS_DEFAULT = "ROS default"


# https://vision.in.tum.de/data/datasets/rgbd-dataset/file_formats, "Calibration of the color camera", also DISTORTIONS
CAMERAS: Mapping[Intrinsics, Camera] = {
    Intrinsics.FREIBURG1: Camera(640, 480, 517.3, 516.5, 318.6, 255.3),
    Intrinsics.FREIBURG2: Camera(640, 480, 520.9, 521.0, 325.1, 249.7),
    Intrinsics.FREIBURG3: Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
    Intrinsics.ROS_DEFAULT: Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
}
DISTORTIONS: Mapping[Intrinsics, Distortion | None] = {
    Intrinsics.FREIBURG1: Distortion(k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633),
    Intrinsics.FREIBURG2: Distortion(k1=0.2312, k2=-0.7849, p1=-0.0033, p2=-0.0001, k3=0.9172),
    Intrinsics.FREIBURG3: None,  # its images were undistorted
    Intrinsics.ROS_DEFAULT: None,
}


@dataclass
class TumRgbd(Recording):
    """A sequence of TUM RGB-D, or a recording of one's own in its layout.

    Colour and depth belong together by time: the closest pairs first, each image once. The true pose is interpolated
    between the two around the time of the colour image, and not known where the nearest is farther than
    `max_difference`.
    """

    intrinsics: Intrinsics = Intrinsics.AUTO
    max_time_difference: float = 0.02  # s, in (0, 1], between colour and its depth, and colour and the nearest pose
    undistort: bool = True  # False: leave the images as they are, as for a camera without distortion

    def __post_init__(self) -> None:
        require(
            0 < self.max_time_difference <= 1, "dataset.max_time_difference", self.max_time_difference, "in (0, 1] s"
        )
        super().__post_init__()

    def open(self) -> Contents:
        (camera, depth_scale, distortion), source = self._stored_camera()
        color, depth = _read_list(self.folder / "rgb.txt"), _read_list(self.folder / "depth.txt")
        pairs = associate(_times(color), _times(depth), self.max_time_difference)
        if not pairs:
            raise DataError(
                f"{self.folder}: no image of rgb.txt has one of depth.txt within dataset.max_time_difference "
                f"({self.max_time_difference:g} s)"
            )
        if len(pairs) < len(color):
            log.info("%s: %d of %d colour images have no depth image", self.name, len(color) - len(pairs), len(color))
        truth = Trajectory.read(self.folder / "groundtruth.txt", self.max_time_difference)
        frames = [_recorded(color[i], depth[j], truth) for i, j in pairs]
        return Contents(camera, source, depth_scale, frames, distortion if self.undistort else None)

    def _stored_camera(self) -> tuple[StoredCamera, Path | str]:
        """The camera, and the file or parameter that gives it."""
        if self.intrinsics is not Intrinsics.AUTO:
            return _published(self.intrinsics)
        named, own = re.search(r"freiburg[123]", self.name), self.folder / "camera.json"
        if named:
            return _published(Intrinsics(named[0]))
        if is_there(own):
            return read_camera(own), own
        raise ConfigError(
            f"dataset.intrinsics: the folder's name {self.name} has no freiburg1, freiburg2 or freiburg3 in it; choose "
            f"FREIBURG1, FREIBURG2, FREIBURG3 or ROS_DEFAULT, or write {own} with {', '.join(CAMERA_KEYS)}"
        )


def _published(intrinsics: Intrinsics) -> tuple[StoredCamera, str]:
    camera = StoredCamera(CAMERAS[intrinsics], DEPTH_SCALE, DISTORTIONS[intrinsics])
    return camera, f"dataset.intrinsics={intrinsics.name}"


@dataclass(frozen=True)
class ListedImage:
    """A line of rgb.txt or depth.txt."""

    timestamp: float  # s
    path: Path


def _times(images: Sequence[ListedImage]) -> list[float]:
    return [image.timestamp for image in images]


@dataclass(frozen=True)
class Trajectory:
    """True poses, to be asked for any time."""

    lines: Sequence[TumLine]  # in order of time; some may be no pose
    timestamps: Float64  # (L,) s, of the lines
    max_time_difference: float  # s

    @classmethod
    def read(cls, path: Path, max_difference: float) -> Trajectory:
        """The trajectory of a file, empty where there is none; of lines with one timestamp the first."""
        found = read_tum_lines(path) if is_there(path) else []
        at: dict[float, TumLine] = {}
        for line in found:
            at.setdefault(line.timestamp, line)
        if len(at) < len(found):
            log.warning("%s: %d poses are left out, as one before has the same timestamp", path, len(found) - len(at))
        lines = sorted(at.values(), key=lambda line: line.timestamp)
        return cls(lines, np.array([line.timestamp for line in lines]), max_difference)

    def at(self, timestamp: float) -> Float64 | None:
        """T_world_camera (4, 4), None where it is not known. Raises DataError when a line that it needs is no pose."""
        after = int(np.searchsorted(self.timestamps, timestamp, side="right"))
        around = range(max(after - 1, 0), min(after + 1, len(self.lines)))
        if not any(abs(self.timestamps[k] - timestamp) <= self.max_time_difference for k in around):
            return None
        a, b = self.lines[around[0]], self.lines[around[-1]]
        if a is b or a.timestamp == timestamp:
            return a.pose()
        return interpolate(a.pose(), b.pose(), (timestamp - a.timestamp) / (b.timestamp - a.timestamp))


def associate(first: Sequence[float], second: Sequence[float], max_difference: float) -> list[tuple[int, int]]:
    """Index pairs of the times (s) that belong together, in the order of `first`'s times.

    The closest pair comes first, then the closest of what is left, as in the benchmark's own associate.py.
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


def _recorded(color: ListedImage, depth: ListedImage, truth: Trajectory) -> RecordedFrame:
    images = StoredImages.of_files(color.path, depth.path)
    return RecordedFrame.posed(images, color.timestamp, lambda: truth.at(color.timestamp))


def _read_list(path: Path) -> list[ListedImage]:
    """The images that a list names, of those with one timestamp the first: association is quadratic in their number.

    Raises DataError, naming file and line, when a line is not `timestamp filename`.
    """
    lines = read_lines(path, missing="is missing: it lists the images' times, a line each: timestamp filename")
    listed = [(n, line) for n, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#")]
    if not listed:
        raise DataError(f"{path} lists no image")
    at: dict[float, ListedImage] = {}
    for n, line in listed:
        image = _listed(path, n, line)
        at.setdefault(image.timestamp, image)
    if len(at) < len(listed):
        log.warning("%s: %d images are left out, as one before has the same timestamp", path, len(listed) - len(at))
    return list(at.values())


def _listed(path: Path, number: int, line: str) -> ListedImage:
    words = line.split(maxsplit=1)
    try:
        timestamp = float(words[0])
    except ValueError:
        timestamp = math.nan
    if len(words) < 2 or not math.isfinite(timestamp) or not words[1].isprintable() or len(words[1]) > LONGEST_NAME:
        raise DataError(f"{path}, line {number}: expected `timestamp filename`, found {line.strip()[:SHOWN]!r}")
    return ListedImage(timestamp, path.parent / words[1].strip())
