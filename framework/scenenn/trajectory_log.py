"""SceneNN's trajectory.log: of each frame a header of three integers and the four rows of T_world_camera, metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.atomic_files import written_whole
from framework.data import Float64, check_rigid
from framework.errors import DataError
from framework.geometry import nearest_rotation

RIGID_WITHIN = 1e-2  # largest entry of |R R^T - I| that is rounding: published poses have six digits, lost ones R = 0
EXACT_WITHIN = 1e-12  # such a rotation is as exact as float64 writes it, and stays as it is
LARGEST_FRAME = 2**31 - 1
BLOCK = 5  # lines of a frame
HEADER = "frame frame frame+1"
LAST_ROW = "0.000000 0.000000 0.000000 1.000000"  # as the published files have it
CUT_OFF = "the file ends before the pose does"


@dataclass(frozen=True)
class TrajectoryLog:
    """What a file says of each frame; frames that it does not name are in neither mapping."""

    poses: Mapping[int, Float64]  # frame from 0 -> T_world_camera (4, 4), exactly rigid
    unusable: Mapping[int, str]  # frame from 0 -> why: not rigid (tracking was lost), not finite, cut off


@dataclass(frozen=True)
class _Line:
    number: int  # in the file, from 1
    words: list[str]

    @property
    def shown(self) -> str:
        return repr(" ".join(self.words)[:60])


def read_trajectory_log(path: Path) -> TrajectoryLog:
    """The poses of a trajectory.log. A frame that the end of the file cuts off is unusable.

    Raises DataError, naming file and line, when a line elsewhere is not as it should be, or a frame is there twice.
    """
    lines = _read_lines(path)
    poses: dict[int, Float64] = {}
    unusable: dict[int, str] = {}
    line_of: dict[int, int] = {}
    for first in range(0, len(lines), BLOCK):
        header, *rows = lines[first : first + BLOCK]
        at_end = first + BLOCK >= len(lines)
        if at_end and not rows and len(header.words) < len(HEADER.split()) and _are_digits(header.words[:1]):
            if len(header.words) > 1:  # else the frame's number may be cut off itself
                unusable[int(header.words[0])] = CUT_OFF
            break
        frame = _frame(path, header)
        if frame in line_of:
            raise DataError(
                f"{path}, line {header.number}: frame {frame} is there already, in line {line_of[frame]}; remove one"
            )
        line_of[frame] = header.number
        matrix = _matrix(path, rows, at_end)
        fault = CUT_OFF if matrix is None else _fault(matrix)
        if matrix is None or fault:
            unusable[frame] = fault
        else:
            poses[frame] = _rigid(matrix)
    return TrajectoryLog(poses, unusable)


def write_trajectory_log(path: Path, poses: Mapping[int, Float64]) -> None:
    """Writes T_world_camera (4, 4) of each frame, whole or not at all; `read_trajectory_log` gives the same back.

    What is rigid within ROTATION_TOLERANCE but not within EXACT_WITHIN comes back as the nearest rigid transform.
    Raises DataError when a frame's number is negative, its pose not rigid, or the disk does not take the file.
    """
    lines = []
    for frame, T_world_camera in sorted(poses.items()):
        if not 0 <= frame <= LARGEST_FRAME:
            raise DataError(f"{path}: a frame's number is from 0 to {LARGEST_FRAME}, found {frame}")
        check_rigid(f"{path}: the pose of frame {frame}", T_world_camera)
        lines.append(f"{frame} {frame} {frame + 1}")
        lines.extend(" ".join(repr(float(value)) for value in row) for row in T_world_camera[:3])
        lines.append(LAST_ROW)
    with written_whole(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in lines), encoding="ascii")


def _read_lines(path: Path) -> list[_Line]:
    """The lines that hold something."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} could not be read: {error.strerror or error}") from error
    lines = (_Line(k, line.decode("latin-1").split()) for k, line in enumerate(content.splitlines(), start=1))
    return [line for line in lines if line.words]


def _frame(path: Path, header: _Line) -> int:
    if len(header.words) != len(HEADER.split()) or not _are_digits(header.words):
        raise DataError(f"{path}, line {header.number}: expected the header of a frame, {HEADER}, found {header.shown}")
    return int(header.words[0])


def _matrix(path: Path, rows: list[_Line], at_end: bool) -> Float64 | None:
    """The four rows (4, 4), finite or not; None when the end of the file cuts them off."""
    matrix = np.empty((4, 4))
    for k, line in enumerate(rows):
        try:
            matrix[k] = [float(word) for word in line.words]
        except ValueError as error:
            if at_end and k == len(rows) - 1 and len(line.words) <= 4:
                return None
            raise DataError(
                f"{path}, line {line.number}: expected row {k + 1} of a 4x4 matrix, four numbers, found {line.shown}"
            ) from error
    return matrix if len(rows) == 4 else None


def _fault(matrix: Float64) -> str:
    """Why these numbers (4, 4) are no pose; "" when they are one."""
    if not np.isfinite(matrix).all():
        return "the pose is not finite"
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        return "the last row of the pose is not 0 0 0 1"
    error, determinant = _rotation_error(matrix), np.linalg.det(matrix[:3, :3])
    if not error <= RIGID_WITHIN or determinant < 0:
        return f"the pose is not rigid: |R R^T - I| is {error:.2g}, det R {determinant:.2g}"
    return ""


def _rigid(matrix: Float64) -> Float64:
    """The rigid transform (4, 4) nearest to a matrix without fault."""
    T_world_camera = np.eye(4)
    T_world_camera[:3] = matrix[:3]
    if _rotation_error(matrix) > EXACT_WITHIN:
        T_world_camera[:3, :3] = nearest_rotation(matrix[:3, :3])
    return T_world_camera


def _rotation_error(matrix: Float64) -> float:
    R = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(R @ R.T - np.eye(3)).max())


def _are_digits(words: list[str]) -> bool:
    """Whether these are numbers that a frame can have."""
    return all(word.isascii() and word.isdigit() and len(word) < 11 and int(word) <= LARGEST_FRAME for word in words)
