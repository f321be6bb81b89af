"""Trajectories in the formats TUM, EuRoC and KITTI.

    TUM     timestamp tx ty tz qx qy qz qw, in s; further columns, such as the ids of RTAB-Map, are ignored
    EuRoC   timestamp,tx,ty,tz,qw,qx,qy,qz, in ns; further columns are ignored (state_groundtruth_estimate0/data.csv of
            Burri et al., IJRR 2016); a header names the columns, such as #timestamp, p_RS_R_x [m], ..., q_RS_w [], ...
    KITTI   the upper 3 x 4 part of T_world_camera, 12 numbers, row-major; line k belongs to frame k (Geiger et al.,
            CVPR 2012; also "Raw" of RTAB-Map)

All translations are in m. The numbers determine the format: EuRoC has commas, and only KITTI has lines of 12 numbers
with a rotation matrix. Sources: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, readme.txt of the
development kit of the KITTI odometry benchmark, and https://github.com/MichaelGrupp/evo/wiki/Formats.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.errors import DataError, errors_of
from framework.files.number_lines import COMMENT, SHOWN, numbers, read_lines
from framework.files.tum_trajectory import COLUMNS, TumLine, read_tum_lines
from framework.geometry import RIGID_WITHIN, nearest_rigid

EUROC_COLUMNS = "timestamp tx ty tz qw qx qy qz"
KITTI_NUMBERS = 12
NANOSECONDS = 1e9  # per second
EARLIEST = 1e15  # ns, minimum Unix time by which a file without a header is recognized

log = logging.getLogger(__name__)

_NANOSECOND_COLUMN = re.compile(r"#\s*timestamp\s*\[ns\]", re.IGNORECASE)
_EUROC_COLUMNS = re.compile(r"#\s*timestamp\s*,\s*p_RS", re.IGNORECASE)  # headers of the published files, also in ns
_SCALAR = re.compile(r"q\w*w", re.IGNORECASE)  # name of the scalar of a quaternion


class TrajectoryFormat(Enum):
    """Format of a trajectory."""

    TUM = "TUM"
    EUROC = "EuRoC"
    KITTI = "KITTI"


@dataclass(frozen=True)
class MatrixLine:
    """A line of a KITTI file, without a timestamp.

    The line is validated on conversion to a pose.
    """

    where: str  # file and line, for messages
    matrix: Float64  # (3, 4), may be NaN
    timestamp: float = math.nan  # unknown
    is_zero: bool = False

    def pose(self) -> Float64:
        """Return the pose T_world_camera (4, 4).

        Raises:
            DataError: The matrix is not a rigid transform.
        """
        with errors_of(self.where):
            return nearest_rigid(np.vstack([self.matrix, [0.0, 0.0, 0.0, 1.0]]))


PoseLine = TumLine | MatrixLine


@dataclass(frozen=True)
class StoredTrajectory:
    """Poses of a file."""

    format: TrajectoryFormat
    timestamps: Float64 | None  # (F,) s, increasing; None = pose k belongs to frame k
    poses: Float64  # (F, 4, 4) T_world_camera


def read_trajectory(path: Path) -> StoredTrajectory:
    """Read a trajectory in TUM, EuRoC or KITTI format.

    Raises:
        DataError: A line is invalid, or the timestamps do not increase.
    """
    kind, lines = read_pose_lines(path)
    poses = np.array([line.pose() for line in lines], np.float64).reshape(-1, 4, 4)
    if kind is TrajectoryFormat.KITTI:
        return StoredTrajectory(kind, None, poses)
    for before, line in pairwise(lines):
        if isinstance(line, TumLine) and line.timestamp <= before.timestamp:
            raise line.error(f"expected a timestamp > {before.timestamp:.12g} s, got {line.timestamp:.12g} s")
    return StoredTrajectory(kind, np.array([line.timestamp for line in lines], np.float64), poses)


def read_pose_lines(path: Path) -> tuple[TrajectoryFormat, Sequence[PoseLine]]:
    """Read the lines of a trajectory in TUM, EuRoC or KITTI format, except comments.

    Raises:
        DataError: A line has the wrong columns, or the format is unknown.
    """
    lines = read_lines(path) if path.exists() else []
    numbered = [(n, text) for n, line in enumerate(lines, start=1) if (text := COMMENT.sub("", line).strip())]
    first = numbered[0][1] if numbered else ""
    if "," in first:
        _check_euroc(path, lines, first)
        log.info("%s: read as camera poses in EuRoC format, with times in ns and quaternions w x y z", path)
        return TrajectoryFormat.EUROC, [_euroc_line(path, n, text, first.count(",")) for n, text in numbered]
    if _is_matrix(first):
        log.info("%s: read as camera poses in KITTI format; line k, from 0, belongs to frame k", path)
        return TrajectoryFormat.KITTI, [_matrix_line(path, n, text) for n, text in numbered]
    return TrajectoryFormat.TUM, read_tum_lines(path)


def _check_euroc(path: Path, lines: Sequence[str], first: str) -> None:
    """Raise DataError if a file with commas does not have the columns of EuRoC."""
    header = next((line for line in lines if line.lstrip().startswith("#") and "," in line), None)
    if header is None:
        time = first.partition(",")[0].strip()
        if not (time.isdecimal() and float(time) >= EARLIEST):
            expected = "expected a header #timestamp [ns], ... or Unix times in ns, as in EuRoC"
            raise DataError(f"{path}: {expected}, got {first[:SHOWN]!r}; write {COLUMNS} in s, without commas")
        return
    names = [name.strip() for name in header.split(",")]
    in_nanoseconds = _NANOSECOND_COLUMN.match(names[0]) or _EUROC_COLUMNS.match(header.lstrip())
    if not in_nanoseconds or len(names) < 8 or not _SCALAR.search(names[4]):
        expected = f"expected a header #timestamp [ns] and the columns {EUROC_COLUMNS}, as in EuRoC"
        raise DataError(f"{path}: {expected}, got {header.strip()[:SHOWN]!r}; write {COLUMNS} in s, without commas")


def _euroc_line(path: Path, number: int, text: str, commas: int) -> TumLine:
    where = f"{path}, line {number}"
    words = [word.strip() for word in text.split(",")]
    if len(words) != commas + 1 or len(words) < 8:
        expected = f"{max(8, commas + 1)} columns ({EUROC_COLUMNS}, and further ones as in the first line)"
        raise DataError(f"{where}: expected {expected}, got {len(words)}")
    _, x, y, z, *quat_wxyz = numbers(where, words[:8], 8, EUROC_COLUMNS)
    if not words[0].isdecimal() or len(words[0]) > 19:
        raise DataError(f"{where}: expected a timestamp in ns without decimals, got {words[0][:SHOWN]!r}")
    return TumLine(path, number, int(words[0]) / NANOSECONDS, (x, y, z), (*quat_wxyz[1:], quat_wxyz[0]))


def _is_matrix(text: str) -> bool:
    """Return True if a line consists of 12 numbers with a rotation matrix."""
    try:
        R = np.reshape(numbers("", text.split(), KITTI_NUMBERS), (3, 4))[:, :3]
    except DataError:
        return False
    with np.errstate(all="ignore"):  # files may contain numbers of any size
        return bool(np.abs(R @ R.T - np.eye(3)).max() <= RIGID_WITHIN)


def _matrix_line(path: Path, number: int, text: str) -> MatrixLine:
    where = f"{path}, line {number}"
    matrix = np.reshape(numbers(where, text.split(), KITTI_NUMBERS, "3 x 4, row-major"), (3, 4))
    return MatrixLine(where, matrix, is_zero=not matrix.any())
