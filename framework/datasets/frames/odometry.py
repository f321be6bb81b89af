"""Odometry of a sequence: poses of wheel, inertial or visual odometry from a file.

    timestamp tx ty tz qx qy qz qw      TUM format, T_odom_base of a moving base, such as a robot or the camera itself

The odometry frame is fixed, but its origin is arbitrary and drifts. Trackers use only the motion between frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Bool, Float64, Int64
from framework.errors import DataError
from framework.files.number_lines import numbers
from framework.files.search_paths import candidates
from framework.files.tum_trajectory import read_tum, rigid_pose
from framework.geometry import interpolate

KEY, CAMERA_KEY = "dataset.odometry", "dataset.odometry_camera"
COLUMNS = "tx ty tz qx qy qz qw"
MAX_GAP = 0.5  # s, maximum interval between poses for interpolation


@dataclass(frozen=True)
class Odometry:
    """The poses of a base in the odometry frame, interpolated in time, and the pose of the camera on the base."""

    timestamps: Float64  # (L,) s, increasing, L >= 2
    T_odom_base: Float64  # (L, 4, 4)
    T_base_camera: Float64  # (4, 4)

    def at(self, timestamp: float) -> Float64 | None:
        """Return T_odom_camera (4, 4) at a time in s; None = unknown, because the poses do not cover this time."""
        if not self.covers(np.array([timestamp]))[0]:
            return None
        k = int(self._intervals(np.array([timestamp]))[0])
        begin, end = self.timestamps[k : k + 2]
        fraction = (timestamp - begin) / (end - begin)
        return interpolate(self.T_odom_base[k], self.T_odom_base[k + 1], fraction) @ self.T_base_camera

    def covers(self, timestamps: Float64) -> Bool:
        """Return True for each time (F,), s, that lies between two poses at most MAX_GAP apart."""
        k = self._intervals(timestamps)
        begin, end = self.timestamps[k], self.timestamps[k + 1]
        return np.asarray((begin <= timestamps) & (timestamps <= end) & (end - begin <= MAX_GAP))

    def _intervals(self, timestamps: Float64) -> Int64:
        """Return the index (F,) of the last pose before each time, limited to the second-last pose."""
        before = np.searchsorted(self.timestamps, timestamps, side="right") - 1
        return np.clip(before, 0, len(self.timestamps) - 2)


@dataclass(frozen=True)
class OdometryFile:
    """File and convention of the odometry of a sequence."""

    # odometry in TUM format (T_odom_base, in any fixed frame), which trackers use to predict the motion; None = none
    odometry: Path | None = None
    # pose T_base_camera of the camera on the base of the odometry, "tx ty tz qx qy qz qw", m, in OpenCV's camera axes;
    # the default is for odometry of the camera itself
    odometry_camera: str = "0 0 0 0 0 0 1"

    def __post_init__(self) -> None:
        self._T_base_camera()

    def read(self) -> Odometry | None:
        """Return the odometry; None = no file is set.

        Raises DataError for a missing file, or with the file and the line of an invalid pose.
        """
        if self.odometry is None:
            return None
        found = candidates(Path(self.odometry))
        path = next((place for place in found if place.is_file()), None)
        if path is None:
            raise DataError(f"{KEY}: expected an existing file in TUM format, got {found[0]}; set another path")
        timestamps, T_odom_base = read_tum(path)
        if len(timestamps) < 2:
            raise DataError(f"{path}: expected at least 2 poses in TUM format, got {len(timestamps)}")
        return Odometry(timestamps, T_odom_base, self._T_base_camera())

    def _T_base_camera(self) -> Float64:
        values = numbers(CAMERA_KEY, self.odometry_camera.split(), len(COLUMNS.split()), COLUMNS)
        return rigid_pose(CAMERA_KEY, values[:3], values[3:])
