"""The poses of any other SLAM system, from a file."""

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
    """Which world the poses are given in."""

    FIRST_FRAME = "that in which the first frame has its true pose, or the identity"
    FILE = "that of the file"


@dataclass
class TrajectoryFile(PoseTracker):
    """Returns the pose that a TUM file has for the frame's timestamp.

    A pose belongs to a frame by time, the nearest one counts: other systems drop frames, so that lines and frames need
    not correspond. By default the whole trajectory is moved as one rigid body so that the first frame that has a pose
    defines the world, as `PoseTracker` says; `world=FILE` keeps the file's own, for which the sequence's true poses
    then mean nothing. A frame that no pose belongs to is skipped. Raises DataError, naming file and line, for a file
    that is not a trajectory: a pose that is not finite or not rigid, timestamps that do not grow.
    """

    path: Path
    max_time_difference: float = 0.02  # s, >= 0: of a frame and its pose; 2/3 of a frame at 30 Hz
    time_offset: float = 0.0  # s, added to the file's timestamps
    world: World = World.FIRST_FRAME

    def __post_init__(self) -> None:
        check_bounds(self, max_time_difference=(0.0, 1e6), time_offset=(-1e12, 1e12))
        self.path = Path(self.path).expanduser()
        timestamps, self._T_file_camera = read_tum(self.path)
        if len(timestamps) == 0:
            raise DataError(f"{self.path} holds no pose: expected a trajectory in TUM format")
        self._timestamps = timestamps + self.time_offset
        self._T_world_file: Float64 | None = np.eye(4) if self.world is World.FILE else None

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Raises NoPoseError for a frame that no pose of the file belongs to."""
        nearest = int(np.abs(self._timestamps - frame.timestamp).argmin())
        difference = abs(float(self._timestamps[nearest]) - frame.timestamp)
        if difference > self.max_time_difference:
            raise NoPoseError(
                f"frame {frame.index}: {self.path.name} has no pose at {frame.timestamp:.3f} s, the nearest is"
                f" {difference:.3f} s away, farther than tracker.max_time_difference"
            )
        T_file_camera = self._T_file_camera[nearest]
        if self._T_world_file is None:
            T_world_first = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            self._T_world_file = T_world_first @ inverse(T_file_camera)
        return Pose(self._T_world_file @ T_file_camera)

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """The poses are of the map's world, as they are given; there is nothing to be found again."""
