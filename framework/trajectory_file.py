"""Trajectories in the TUM format: a line a pose, `timestamp tx ty tz qx qy qz qw`, T_world_camera, metres, seconds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from framework.atomic_files import written_whole
from framework.data import Bool, Float64, check_rigid
from framework.errors import DataError

COLUMNS = "timestamp tx ty tz qx qy qz qw"
QUATERNION_TOLERANCE = 1e-2  # of the norm: published quaternions carry as few as 4 digits


def read_tum(path: Path) -> tuple[Float64, Float64]:
    """Timestamps (F,) s and poses T_world_camera (F, 4, 4) of a TUM file, in the file's order.

    Empty lines and those that begin with `#` are skipped. Raises DataError, naming file and line, when a line does not
    hold eight finite numbers with a unit quaternion, or when timestamps do not grow.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist: expected a trajectory in TUM format") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} could not be read as text: {error}") from error
    numbered = [
        (n, line) for n, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#")
    ]
    rows = np.array([_row(path, n, line) for n, line in numbered], np.float64).reshape(-1, 8)
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    _refuse(path, numbered, np.abs(norms - 1) > QUATERNION_TOLERANCE, "qx qy qz qw must have length 1")
    _refuse(path, numbered, np.diff(rows[:, 0], prepend=-np.inf) <= 0, "timestamps must grow from line to line")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, 3] = rows[:, 1:4]
    if len(rows):
        T[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return rows[:, 0], T


def write_tum(path: Path, timestamps: Sequence[float] | Float64, poses: Sequence[Float64] | Float64) -> None:
    """Writes T_world_camera (4, 4) of each timestamp, whole or not at all; `read_tum` gives them back to 1e-9.

    Raises DataError when there are not equally many, a pose is not rigid, or the disk does not take the file.
    """
    if len(timestamps) != len(poses):
        raise DataError(f"{path}: {len(timestamps)} timestamps for {len(poses)} poses; there must be equally many")
    for k, T in enumerate(poses):
        check_rigid(f"{path}: pose {k}", T)
    T_all = np.array(poses, np.float64).reshape(-1, 4, 4)
    quat_xyzw = Rotation.from_matrix(T_all[:, :3, :3]).as_quat(canonical=True) if len(T_all) else np.zeros((0, 4))
    rows = np.column_stack([T_all[:, :3, 3], quat_xyzw])
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for timestamp, row in zip(timestamps, rows, strict=True):
            file.write(f"{timestamp:.9f} " + " ".join(f"{value:.12g}" for value in row) + "\n")


def _row(path: Path, number: int, line: str) -> list[float]:
    words = line.split()
    if len(words) != 8:
        raise DataError(f"{path}, line {number}: expected 8 numbers ({COLUMNS}), found {len(words)}")
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{path}, line {number}: expected 8 numbers ({COLUMNS}): {error}") from error
    if not np.isfinite(values).all():
        raise DataError(f"{path}, line {number}: expected finite numbers ({COLUMNS}), found {line.strip()!r}")
    return values


def _refuse(path: Path, numbered: list[tuple[int, str]], wrong: Bool, expected: str) -> None:
    """Raises DataError for the first line that is `wrong` (F,)."""
    if wrong.any():
        number, line = numbered[int(wrong.argmax())]
        raise DataError(f"{path}, line {number}: {expected}, found {line.strip()!r}")
