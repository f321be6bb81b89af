"""Trajectories in the TUM format.

A line contains one pose T_world_camera: `timestamp tx ty tz qx qy qz qw`, in s and m. If all lines have the same number
of further columns, such as the ids of RTAB-Map, these are ignored. evo is not used because of its GPL license.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from framework.data import Float64, check_rigid
from framework.errors import DataError
from framework.files.atomic_write import atomic_write
from framework.files.number_lines import COMMENT, SHOWN, numbers, read_lines

COLUMNS = "timestamp tx ty tz qx qy qz qw"
QUATERNION_TOLERANCE = 1e-2  # maximum | |q| - 1 | due to rounding


@dataclass(frozen=True)
class TumLine:
    """A line of a TUM file.

    The line is validated on conversion to a pose.
    """

    path: Path
    number: int  # line number in the file, from 1
    timestamp: float  # s
    position: tuple[float, ...]  # (3,) m, may be NaN
    quat_xyzw: tuple[float, ...]  # (4,), may be NaN

    @property
    def is_zero(self) -> bool:
        """True if all numbers of the pose are 0, as some programs write for an unknown pose."""
        return not any((*self.position, *self.quat_xyzw))

    def pose(self) -> Float64:
        """Return the pose T_world_camera (4, 4).

        Raises:
            DataError: The pose is not finite, or the quaternion does not have unit length.
        """
        return rigid_pose(self._place, self.position, self.quat_xyzw)

    def error(self, message: str) -> DataError:
        return DataError(f"{self._place}: {message}")

    @property
    def _place(self) -> str:
        return f"{self.path}, line {self.number}"


def rigid_pose(place: str, position: Sequence[float], quat_xyzw: Sequence[float]) -> Float64:
    """Return the pose (4, 4) with a given position and orientation.

    Args:
        place: The location in the file, for messages.
        position: The position (3,), m.
        quat_xyzw: The orientation (4,), a unit quaternion.

    Raises:
        DataError: The pose is not finite, or the quaternion does not have unit length.
    """
    norm = math.hypot(*quat_xyzw)
    if not all(map(math.isfinite, (*position, norm))):
        found = " ".join(f"{value:g}" for value in (*position, *quat_xyzw))
        raise DataError(f"{place}: expected a finite pose, got {found}")
    if abs(norm - 1) > QUATERNION_TOLERANCE:
        raise DataError(f"{place}: expected a quaternion qx qy qz qw of length 1, got {norm:.4g}")
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_quat(quat_xyzw).as_matrix()
    T_world_camera[:3, 3] = position
    return T_world_camera


def read_tum(path: Path) -> tuple[Float64, Float64]:
    """Read the timestamps (F,), s, and the poses T_world_camera (F, 4, 4) in a TUM file.

    Raises:
        DataError: A line is invalid, or the timestamps do not increase.
    """
    lines = read_tum_lines(path)
    for before, line in pairwise(lines):
        if line.timestamp <= before.timestamp:
            raise line.error(f"expected a timestamp > {before.timestamp:.12g} s, got {line.timestamp:.12g} s")
    timestamps = np.array([line.timestamp for line in lines], np.float64)
    return timestamps, np.array([line.pose() for line in lines], np.float64).reshape(-1, 4, 4)


def read_tum_lines(path: Path) -> list[TumLine]:
    """Read the lines of a TUM file, except comments.

    Raises:
        DataError: A line does not contain eight numbers, or it has more or fewer columns than the first line.
    """
    lines = read_lines(path, missing="expected a trajectory in TUM format, got no such file")
    words = [COMMENT.sub("", line).split() for line in lines]
    columns = max(len(COLUMNS.split()), len(next(filter(None, words), [])))
    return [_line(path, number, found, columns) for number, found in enumerate(words, start=1) if found]


def write_tum(
    path: Path,
    timestamps: Sequence[float] | Float64,
    poses: Sequence[Float64] | Float64,
    comments: Sequence[str] = (),
) -> None:
    """Write a trajectory in the TUM format atomically.

    Args:
        path: The output file.
        timestamps: The timestamps (F,), s.
        poses: The poses T_world_camera (F, 4, 4).
        comments: Lines before the first pose.

    Raises:
        DataError: The lengths differ, a pose is not rigid, or the file cannot be written.
    """
    if len(timestamps) != len(poses):
        raise DataError(f"{path}: expected a timestamp for each pose, got {len(timestamps)} for {len(poses)} poses")
    for k, T in enumerate(poses):
        check_rigid(f"{path}: pose {k}", T)
    T_all = np.array(poses, np.float64).reshape(-1, 4, 4)
    quat_xyzw = Rotation.from_matrix(T_all[:, :3, :3]).as_quat(canonical=True) if len(T_all) else np.zeros((0, 4))
    rows = np.column_stack([T_all[:, :3, 3], quat_xyzw])
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(f"# {comment}\n" for comment in comments)
        for timestamp, row in zip(timestamps, rows, strict=True):
            file.write(f"{timestamp:.9f} " + " ".join(f"{value:.12g}" for value in row) + "\n")


def _line(path: Path, number: int, words: list[str], columns: int) -> TumLine:
    pose = len(COLUMNS.split())
    if pose < columns != len(words):
        expected = f"expected {columns} columns, as in the first line"
        raise DataError(f"{path}, line {number}: {expected}, got {len(words)}")
    values = numbers(f"{path}, line {number}", words[:pose] if pose < columns else words, pose, COLUMNS)
    if not math.isfinite(values[0]):
        raise DataError(f"{path}, line {number}: expected a finite timestamp, got {words[0][:SHOWN]!r}")
    return TumLine(path, number, values[0], tuple(values[1:4]), tuple(values[4:]))
