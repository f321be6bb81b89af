"""Trajectories in the formats TUM, EuRoC and KITTI.

    TUM     timestamp tx ty tz qx qy qz qw, in s; further columns, such as the ids of RTAB-Map, are ignored
    EuRoC   timestamp,tx,ty,tz,qw,qx,qy,qz, in ns; further columns are ignored (state_groundtruth_estimate0/data.csv of
            Burri et al., IJRR 2016); a header names the columns, such as #timestamp, p_RS_R_x [m], ..., q_RS_w [], ...
    KITTI   the upper 3 x 4 part of T_world_camera, 12 numbers, row-major; line k belongs to frame k (Geiger et al.,
            CVPR 2012; also "Raw" of RTAB-Map); or all 16 numbers

All translations are in m. The numbers determine the format: only KITTI has lines of 12 numbers with a rotation matrix,
and EuRoC has commas. A header that names the columns of other files with commas determines their order and the unit of
time. Sources: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, readme.txt of the
development kit of the KITTI odometry benchmark, and https://github.com/MichaelGrupp/evo/wiki/Formats.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.errors import DataError
from framework.files.number_lines import SHOWN, PrintedMatrix, numbers, read_lines
from framework.files.trajectory_columns import EUROC, NANOSECOND, SEPARATORS, Columns, without_header, words_of
from framework.files.tum_trajectory import TumLine, posed_lines, read_tum_lines
from framework.geometry import RIGID_WITHIN

KITTI_NUMBERS = (12, 16)
EARLIEST = 1e15  # ns, minimum Unix time by which nanoseconds are recognized
LAST_ROW = (0.0, 0.0, 0.0, 1.0)  # of a 4 x 4 transform
HEADER = "timestamp,tx,ty,tz,qx,qy,qz,qw"

log = logging.getLogger(__name__)


class TrajectoryFormat(Enum):
    """Format of a trajectory."""

    TUM = "TUM"
    EUROC = "EuRoC"  # or another order of columns that a header names, with commas
    KITTI = "KITTI"


@dataclass(frozen=True)
class MatrixLine(PrintedMatrix):
    """A line of a KITTI file, without a timestamp."""

    timestamp: float = math.nan  # unknown

    @property
    def is_zero(self) -> bool:
        """True if all numbers of the pose are 0, as some programs write for an unknown pose."""
        return not self.values[:3].any()


PoseLine = TumLine | MatrixLine


@dataclass(frozen=True)
class StoredTrajectory:
    """Poses of a file."""

    format: TrajectoryFormat
    timestamps: Float64 | None  # (F,) s, increasing; None = pose k belongs to frame k
    poses: Sequence[Float64 | None]  # (F,) T_world_camera (4, 4); None = unknown, stored as zeros


def read_trajectory(path: Path) -> StoredTrajectory:
    """Read a trajectory in TUM, EuRoC or KITTI format.

    Raises:
        DataError: A line is invalid, or the timestamps do not increase.
    """
    kind, lines = read_pose_lines(path)
    poses = [None if line.is_zero else line.pose() for line in lines]
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
    if not path.exists():
        return TrajectoryFormat.TUM, read_tum_lines(path)  # raises
    columns, numbered = without_header(read_lines(path))
    rows = [(n, words_of(text)) for n, text in numbered]
    matrix = next((words for _, words in rows if _is_matrix(words)), None)  # the first lines may be zeros
    if matrix is not None:
        log.info("%s: read as camera poses in KITTI format; line k, from 0, belongs to frame k", path)
        return TrajectoryFormat.KITTI, [_matrix_line(path, n, words, len(matrix)) for n, words in rows]
    first: Sequence[str] = rows[0][1] if rows else ()
    if _is_matrix(first[1:]):
        expected = f"expected 12 numbers (3 x 4, row-major), where line k belongs to frame k, got {len(first)}"
        raise DataError(f"{path}: {expected}; remove the first column")
    if not any(separator in text for _, text in numbered[:1] for separator in SEPARATORS):
        return TrajectoryFormat.TUM, read_tum_lines(path)
    columns = _columns_with_unit(path, columns, rows[0][1])
    is_euroc = (columns.order, columns.time_unit) == (EUROC.order, EUROC.time_unit)
    form = "in EuRoC format" if is_euroc else "as named by the header"
    log.info("%s: read as camera poses %s, with %s", path, form, columns)
    return TrajectoryFormat.EUROC, posed_lines(path, columns, rows)


def _columns_with_unit(path: Path, columns: Columns | None, words: Sequence[str]) -> Columns:
    """Return the columns of a file with commas, with the unit of time.

    Raises:
        DataError: The columns are unknown.
    """
    time = words[columns.time if columns else 0]
    in_nanoseconds = time.replace(".", "", 1).isdecimal() and float(time) >= EARLIEST
    if columns is None and not in_nanoseconds:
        expected = f"expected a header that names the columns, such as {HEADER}, or Unix times in ns, as in EuRoC"
        raise DataError(f"{path}: {expected}, got {','.join(words)[:SHOWN]!r}; add the header")
    columns = columns or EUROC
    unit = columns.time_unit or (NANOSECOND if in_nanoseconds else 1.0)
    return replace(columns, time_unit=unit)


def _is_matrix(words: Sequence[str]) -> bool:
    """Return True if a line consists of 12 or 16 numbers with a rotation matrix."""
    if len(words) not in KITTI_NUMBERS:
        return False
    try:
        matrix = np.reshape(numbers("", words, len(words)), (-1, 4))
    except DataError:
        return False
    R = matrix[:3, :3]
    with np.errstate(all="ignore"):  # files may contain numbers of any size
        return bool(np.abs(R @ R.T - np.eye(3)).max() <= RIGID_WITHIN) and np.allclose(matrix[3:], LAST_ROW)


def _matrix_line(path: Path, number: int, words: Sequence[str], count: int) -> MatrixLine:
    where = f"{path}, line {number}"
    matrix = np.reshape(numbers(where, words, count, f"{count // 4} x 4, row-major"), (-1, 4))[:3]
    return MatrixLine(where, np.vstack([matrix, LAST_ROW]))
