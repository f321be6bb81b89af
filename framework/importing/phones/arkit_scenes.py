"""Import of scans of ARKitScenes (Baruch et al., NeurIPS 2021; DATA.md of https://github.com/apple/ARKitScenes).

    41069021_frames/lowres_wide/41069021_309.300.png    8-bit color, 256x192; named by video and timestamp, s
    lowres_depth/41069021_309.300.png                   uint16 mm, 256x192
    confidence/41069021_309.300.png                     uint8 0 to 2, from ARKit; in the raw dataset
    lowres_wide_intrinsics/41069021_309.300.pincam      width height fx fy cx cy, of color
    lowres_wide.traj                                    timestamp, s; rotation vector, rad; translation, m

The folders of the raw dataset are in 41069021/. A pose is T_camera_world with OpenCV's camera axes, and the z axis of
the world points up. Timestamps in names are rounded: the loader of the publication (tenFpsDataLoader.py) accepts
intrinsics within 0.001 s and poses within 0.005 s. Images without such a pose are not imported.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Camera, Float64
from framework.datasets.calibration.camera_json import pinhole
from framework.errors import DataError
from framework.files.image_files import read_color, read_uint8, read_uint16
from framework.files.number_lines import numbers, read_lines
from framework.geometry import inverse
from framework.importing.source import DeviceFrame, Format, Source, meters
from framework.sensors.noise_models import SensorKind

COLOR, DEPTH, INTRINSICS, CONFIDENCE = "lowres_wide", "lowres_depth", "lowres_wide_intrinsics", "confidence"
TRAJECTORY = "lowres_wide.traj"
POSE_COLUMNS = "timestamp, 3 of the rotation vector, 3 of the translation"
CAMERA_COLUMNS = "width height fx fy cx cy"
MAX_POSE_DIFFERENCE = 0.005  # s, between an image and its pose
MILLISECONDS = 1000  # per second; names have this resolution

_NAME = re.compile(r"[0-9]+_([0-9]{1,12}\.[0-9]{1,9})")


@dataclass(frozen=True)
class AxisAngleLine:
    """A line of the trajectory."""

    where: str  # file and line, for messages
    timestamp: float  # s
    values: tuple[float, ...]  # (6,) rotation vector, rad, and translation, m, of T_camera_world; may be NaN

    def pose(self) -> Float64:
        """Return the pose T_world_camera (4, 4).

        Raises:
            DataError: The pose is not finite.
        """
        if not all(map(math.isfinite, self.values)):
            raise DataError(f"{self.where}: expected a finite pose, got {' '.join(f'{v:g}' for v in self.values)}")
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3] = Rotation.from_rotvec(self.values[:3]).as_matrix()
        T_camera_world[:3, 3] = self.values[3:]
        return inverse(T_camera_world)


def recognized(path: Path) -> bool:
    """Return True if the path is a scan of ARKitScenes."""
    return (path / TRAJECTORY).is_file() and (path / COLOR).is_dir()


def open_source(path: Path) -> Source:
    """Open a scan.

    Raises:
        DataError: The trajectory is invalid, or a folder has no images.
    """
    lines = _read_trajectory(path / TRAJECTORY)
    colors, depths, cameras = (
        _by_time(path / name, suffix) for name, suffix in ((COLOR, ".png"), (DEPTH, ".png"), (INTRINSICS, ".pincam"))
    )
    confidences = _by_time(path / CONFIDENCE, ".png") if (path / CONFIDENCE).is_dir() else None
    times = np.array([line.timestamp for line in lines])

    def read(time: int) -> DeviceFrame:
        line = lines[int(np.abs(times - time / MILLISECONDS).argmin())]
        color = colors[time]
        difference = abs(line.timestamp - time / MILLISECONDS)
        if difference > MAX_POSE_DIFFERENCE:
            expected = f"expected a pose within {MAX_POSE_DIFFERENCE:g} s in {path / TRAJECTORY}"
            raise DataError(f"{color}: {expected}, got the nearest pose {difference:.3f} s away")
        T_world_camera = line.pose()
        return DeviceFrame(
            name=color,
            timestamp=time / MILLISECONDS,
            camera=_read_camera(_near(cameras, time, color, INTRINSICS)),
            color=read_color(color),
            depth=meters(read_uint16(_near(depths, time, color, DEPTH))),
            confidence=None if confidences is None else read_uint8(_near(confidences, time, color, CONFIDENCE)),
            T_world_camera=T_world_camera,
            up=np.array(T_world_camera[2, :3]),
        )

    frames = [partial(read, time) for time in colors]
    return Source("ARKitScenes", frames, len(frames), posed=True, sensor=SensorKind.PHONE_LIDAR)


def _read_trajectory(path: Path) -> Sequence[AxisAngleLine]:
    numbered = [(f"{path}, line {n}", line.split()) for n, line in enumerate(read_lines(path), start=1) if line.strip()]
    lines = []
    for where, words in numbered:
        timestamp, *pose = numbers(where, words, 7, POSE_COLUMNS)
        if not math.isfinite(timestamp):
            raise DataError(f"{where}: expected a finite timestamp, got {words[0]!r}")
        lines.append(AxisAngleLine(where, timestamp, tuple(pose)))
    if not lines:
        raise DataError(f"{path}: expected poses, got an empty file")
    return lines


def _by_time(folder: Path, suffix: str) -> dict[int, Path]:
    """Return the files in a folder by timestamp, ms, in ascending order."""
    names = {path: _NAME.fullmatch(path.stem) for path in folder.glob(f"*{suffix}")}
    files = {round(float(match[1]) * MILLISECONDS): path for path, match in names.items() if match}
    if not files:
        raise DataError(
            f"{folder}: expected files such as 41069021_309.300{suffix}, got none; download this asset, too"
        )
    return dict(sorted(files.items()))


def _near(files: dict[int, Path], time: int, color: Path, asset: str) -> Path:
    """Return the file within a millisecond of a color image."""
    for near in (time, time - 1, time + 1):
        if near in files:
            return files[near]
    raise DataError(f"{color}: expected a file within 0.001 s in {asset}/, got none")


def _read_camera(path: Path) -> Camera:
    words = " ".join(read_lines(path)).split()
    return pinhole(path, *numbers(str(path), words, 6, CAMERA_COLUMNS))


NEEDS = "a folder with lowres_wide/, lowres_depth/, lowres_wide_intrinsics/ and lowres_wide.traj of ARKitScenes"
FORMAT = Format("arkit_scenes", NEEDS, recognized, open_source)
