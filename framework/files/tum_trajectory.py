"""Trajectories in the TUM format.

A line contains one pose T_world_camera: `timestamp tx ty tz qx qy qz qw`, in s and m. A header that names the columns
in another order is applied. If all lines have the same number of further columns, such as the ids of RTAB-Map, these
are ignored. evo is not used because of its GPL license.
"""

from __future__ import annotations

import logging
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
from framework.files.manifest import verified
from framework.files.number_lines import SHOWN, numbers, read_lines
from framework.files.trajectory_columns import NANOSECOND, TUM, Columns, without_header

COLUMNS = "timestamp tx ty tz qx qy qz qw"
log = logging.getLogger(__name__)

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
        DataError: A line is invalid, the timestamps do not increase, or the file of a run has changed.
    """
    with verified(path):
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
    columns, rows = without_header(read_lines(path, missing="expected a trajectory in TUM format, got no such file"))
    if columns is not None and (columns.order, columns.time_unit or 1.0) != (TUM.order, TUM.time_unit):
        log.info("%s: read as named by the header: %s", path, columns)
    return posed_lines(path, columns or TUM, [(number, text.split()) for number, text in rows])


def posed_lines(path: Path, columns: Columns, rows: Sequence[tuple[int, Sequence[str]]]) -> list[TumLine]:
    """Return the poses in numbered lines of words.

    Raises:
        DataError: A line does not have the columns, or it has more or fewer columns than the first line.
    """
    width = max(columns.count, len(rows[0][1]) if rows else 0)
    return [_line(path, number, words, columns, width) for number, words in rows]


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


def _line(path: Path, number: int, words: Sequence[str], columns: Columns, width: int) -> TumLine:
    where = f"{path}, line {number}"
    if len(COLUMNS.split()) < width != len(words):
        raise DataError(f"{where}: expected {width} columns, as in the first line, got {len(words)}")
    pose = columns.chosen(words) if len(words) == width else words
    timestamp, *values = numbers(where, pose, len(COLUMNS.split()), COLUMNS)
    if not math.isfinite(timestamp):
        raise DataError(f"{where}: expected a finite timestamp, got {pose[0][:SHOWN]!r}")
    if columns.time_unit == NANOSECOND and not timestamp.is_integer():
        raise DataError(f"{where}: expected a timestamp in ns without decimals, got {pose[0][:SHOWN]!r}")
    return TumLine(path, number, timestamp * (columns.time_unit or 1.0), tuple(values[:3]), tuple(values[3:]))
