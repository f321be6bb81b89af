"""Poses from another SLAM system, read from a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Float64, Frame, Pose
from framework.errors import DataError, NoPoseError
from framework.files.tum_trajectory import read_tum
from framework.geometry import inverse
from framework.interfaces import PoseTracker, SceneMap


class World(Enum):
    """World frame of the poses."""

    FIRST_FRAME = "ground-truth pose of the first frame, or the identity"
    FILE = "frame of the file"


@dataclass
class TrajectoryFile(PoseTracker):
    """Poses from a trajectory file in TUM format.

    Each frame gets the pose nearest in time. Frames without such a pose are skipped. By default, the trajectory is
    moved rigidly, so that the first frame with a pose defines the world frame. `world_frame=FILE` keeps the world frame
    of the file. The ground-truth poses of the sequence are then invalid, because they have another world frame. The
    tracker raises DataError if a pose is not finite or not rigid, or if timestamps do not increase.
    """

    poses_given = True

    path: Path  # trajectory in TUM format
    # maximum time difference between a frame and its pose, s, >= 0; frames without a pose are skipped
    max_time_difference: float = 0.02
    time_offset: float = 0.0  # offset added to the timestamps of the file, s
    world_frame: World = World.FIRST_FRAME  # world frame of the poses

    def __post_init__(self) -> None:
        check_bounds(self, max_time_difference=(0.0, 1e6), time_offset=(-1e12, 1e12))
        self.path = Path(self.path).expanduser()
        timestamps, self._T_file_camera = read_tum(self.path)
        if len(timestamps) == 0:
            raise DataError(f"{self.path}: expected poses in TUM format, got none")
        self._timestamps = timestamps + self.time_offset
        self._T_world_file: Float64 | None = np.eye(4) if self.world_frame is World.FILE else None

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Return the pose from the file.

        Raises:
            NoPoseError: If the file has no pose for the frame.
        """
        nearest = int(np.abs(self._timestamps - frame.timestamp).argmin())
        difference = abs(float(self._timestamps[nearest]) - frame.timestamp)
        if difference > self.max_time_difference:
            raise NoPoseError(
                f"frame {frame.index}: {self.path.name}: expected a pose within {self.max_time_difference:g} s "
                f"(tracker.max_time_difference) of {frame.timestamp:.3f} s, got the nearest pose {difference:.3f} s "
                "away"
            )
        T_file_camera = self._T_file_camera[nearest]
        if self._T_world_file is None:
            T_world_first = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            self._T_world_file = T_world_first @ inverse(T_file_camera)
        return Pose(self._T_world_file @ T_file_camera)

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """Do nothing, because the poses are in the world frame of the map."""
