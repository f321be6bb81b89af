"""Poses from another SLAM system, read from a file."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Float64, Frame, Pose
from framework.datasets.frames.conventions import TIME_UNITS
from framework.errors import DataError, NoPoseError
from framework.files.pose_lines import read_trajectory
from framework.geometry import inverse
from framework.interfaces import PoseTracker, SceneMap

LONGEST_STEP = 10.0  # s, longest plausible time between poses, and between the poses and a frame of the same clock


class World(Enum):
    """World frame of the poses."""

    FIRST_FRAME = "ground-truth pose of the first frame, or the identity"
    FILE = "frame of the file"


@dataclass
class TrajectoryFile(PoseTracker):
    """Poses from a trajectory file in TUM, EuRoC or KITTI format.

    Each frame gets the pose nearest in time. KITTI files have no timestamps: line k, from 0, is the pose of frame k of
    the recording. Frames without such a pose are skipped. By default, the trajectory is moved rigidly, so that the
    first frame with a pose defines the world frame. `world_frame=FILE` keeps the world frame of the file. The
    ground-truth poses of the sequence are then invalid, because they have another world frame. The tracker raises
    DataError if a pose is not finite or not rigid, or if timestamps do not increase.
    """

    poses_given = True

    path: Path  # trajectory in TUM, EuRoC or KITTI format
    # maximum time difference between a frame and its pose, s, >= 0; frames without a pose are skipped
    max_time_difference: float = 0.02
    time_unit: float = 1.0  # length of one unit of the timestamps of the file, s, in [1e-9, 1]; 1e-9 = nanoseconds
    time_offset: float = 0.0  # offset added to the timestamps of the file, s
    world_frame: World = World.FIRST_FRAME  # world frame of the poses

    def __post_init__(self) -> None:
        check_bounds(self, max_time_difference=(0.0, 1e6), time_unit=(1e-9, 1.0), time_offset=(-1e12, 1e12))
        self.path = Path(self.path).expanduser()
        trajectory = read_trajectory(self.path)
        self._T_file_camera = trajectory.poses
        if all(T is None for T in self._T_file_camera):
            raise DataError(f"{self.path}: expected poses, got none")
        stored = trajectory.timestamps
        self._timestamps = None if stored is None else stored * self.time_unit + self.time_offset
        self._T_world_file: Float64 | None = np.eye(4) if self.world_frame is World.FILE else None

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Return the pose from the file.

        Raises:
            NoPoseError: If the file has no pose for the frame.
        """
        T_file_camera = self._T_file_camera[self._pose_index(frame)]
        if T_file_camera is None:
            raise NoPoseError(f"frame {frame.index}: {self.path.name}: expected a pose, got only zeros")
        if self._T_world_file is None:
            T_world_first = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            self._T_world_file = T_world_first @ inverse(T_file_camera)
        return Pose(self._T_world_file @ T_file_camera)

    def given_pose(self, frame: Frame) -> Float64 | None:
        """Return the pose T_file_camera (4, 4) of a frame, None = unknown."""
        with suppress(NoPoseError):
            return self._T_file_camera[self._pose_index(frame)]
        return None

    def _pose_index(self, frame: Frame) -> int:
        """Return the index of the pose of a frame."""
        if self._timestamps is None:
            if frame.index >= len(self._T_file_camera):
                expected = f"expected a line for each frame, got {len(self._T_file_camera)} lines"
                raise NoPoseError(f"frame {frame.index}: {self.path.name}: {expected}")
            return frame.index
        nearest = int(np.abs(self._timestamps - frame.timestamp).argmin())
        difference = abs(float(self._timestamps[nearest]) - frame.timestamp)
        if difference > self.max_time_difference:
            raise NoPoseError(
                f"frame {frame.index}: {self.path.name}: expected a pose within {self.max_time_difference:g} s "
                f"(tracker.max_time_difference) of {frame.timestamp:.3f} s, got the nearest pose {difference:.3f} s "
                f"away{self._time_fix(self._timestamps, frame.timestamp)}"
            )
        return nearest

    def _time_fix(self, times: Float64, timestamp: float) -> str:
        """Return the setting that brings poses at `times` to the clock of a frame at `timestamp`, s, or ""."""
        stored = (times - self.time_offset) / self.time_unit
        step = float(np.median(np.diff(stored))) if len(stored) > 1 else abs(float(stored[0]))
        for unit, name in TIME_UNITS.items():
            is_near = np.abs(stored * unit - timestamp).min() <= self.max_time_difference
            if step * self.time_unit > LONGEST_STEP and is_near:
                return f"; set tracker.time_unit={unit:g} (the timestamps are in {name})"
        first, last = times[[0, -1]]
        if first - LONGEST_STEP <= timestamp <= last + LONGEST_STEP:
            return ""
        offset = timestamp - first + self.time_offset
        return (
            f"; the poses are from {first:.6f} to {last:.6f} s: set tracker.time_offset={offset:.6f} if the first pose "
            "is that of this frame"
        )

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """Do nothing, because the poses are in the world frame of the map."""
