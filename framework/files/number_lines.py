"""Text files with lines of numbers.

np.loadtxt is not used, because it does not parse the NaN of Microsoft's C library and does not report line numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64
from framework.errors import DataError, errors_of
from framework.files.atomic_write import atomic_write, read_text
from framework.geometry import nearest_rigid

SHOWN = 60  # maximum number of characters that an error message quotes from a file
COMMENT = re.compile(r"(?<!1\.)#.*")  # 1.#IND is NaN in Microsoft's C library
GRAVITY_COLUMNS = "x y z"
IMAGE_TIME_COLUMNS = "color depth"
MIN_LENGTH, MAX_LENGTH = 1e-6, 1e6  # limits of the stored length of a direction

_NO_NUMBER = re.compile(r"[+-]?(1\.#\w+|nan\(\w+\))", re.ASCII | re.IGNORECASE)


def read_lines(path: Path, missing: str = "expected a text file, got no such file") -> list[str]:
    """Return the lines of a text file.

    Raises:
        DataError: The file cannot be read. The message is `missing` if the file does not exist.
    """
    if not path.exists():
        raise DataError(f"{path}: {missing}")
    return read_text(path).splitlines()


def number(word: str) -> float:
    """Parse a number.

    Special values of Microsoft's C library (-1.#IND, 1.#INF) become NaN.

    Raises:
        ValueError: The word is not a number.
    """
    return math.nan if _NO_NUMBER.fullmatch(word) else float(word)


def numbers(where: str, words: Sequence[str], count: int, names: str = "") -> list[float]:
    """Parse the words of a line as numbers, possibly NaN.

    Args:
        where: The file and the line, for messages.
        words: The words.
        count: The expected number of words.
        names: The names of the columns, for messages.

    Raises:
        DataError: There are more or fewer words, or a word is not a number.
    """
    expected = f"{where}: expected {count} numbers{f' ({names})' if names else ''}"
    if len(words) != count:
        raise DataError(f"{expected}, got {len(words)}")
    values = []
    for word in words:
        try:
            values.append(number(word))
        except ValueError as error:
            raise DataError(f"{expected}, got {word[:SHOWN]!r}") from error
    return values


def read_gravity(path: Path) -> list[Float64 | None]:
    """Read the up direction of each frame as a unit vector (3,) in the camera frame, or None if unknown.

    A line contains `x y z`, or `nan nan nan` if unknown. Empty lines and comments after `#` are skipped.

    Raises:
        DataError: A line is invalid.
    """
    words = [COMMENT.sub("", line).split() for line in read_lines(path)]
    return [_direction(f"{path}, line {n}", found) for n, found in enumerate(words, start=1) if found]


def write_gravity(path: Path, ups: Sequence[Float64 | None]) -> None:
    """Write the up direction (3,) of each frame in the format of `read_gravity`."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for up in ups:
            file.write("nan nan nan\n" if up is None else " ".join(f"{value:.9f}" for value in up) + "\n")


def read_image_times(path: Path) -> list[tuple[float, float]]:
    """Read the timestamps of color and depth of each frame, s.

    A line contains `color depth`; or all lines contain one timestamp of both images. Empty lines and comments after `#`
    are skipped.

    Raises:
        DataError: A line is invalid.
    """
    words = [(n, COMMENT.sub("", line).split()) for n, line in enumerate(read_lines(path), start=1)]
    has_one_column = all(len(found) <= 1 for _, found in words)
    times = []
    for n, found in words:
        if not found:
            continue
        color, depth = numbers(f"{path}, line {n}", found * 2 if has_one_column else found, 2, IMAGE_TIME_COLUMNS)
        if not (math.isfinite(color) and math.isfinite(depth)):
            raise DataError(f"{path}, line {n}: expected finite timestamps, got {' '.join(found)!r}")
        times.append((color, depth))
    return times


def write_image_times(path: Path, times: Sequence[tuple[float, float]]) -> None:
    """Write the timestamps of color and depth of each frame, s, in the format of `read_image_times`."""
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(f"# {IMAGE_TIME_COLUMNS}\n")
        for color, depth in times:
            file.write(f"{color:.9f} {depth:.9f}\n")


def _direction(where: str, words: Sequence[str]) -> Float64 | None:
    values = numbers(where, words, 3, GRAVITY_COLUMNS)
    if all(map(math.isnan, values)):
        return None
    length = math.hypot(*values)
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        expected = f"expected a direction x y z of length {MIN_LENGTH:g} to {MAX_LENGTH:g}, or nan nan nan if unknown"
        raise DataError(f"{where}: {expected}, got {' '.join(words)!r}")
    return np.array(values) / length


@dataclass(frozen=True)
class PrintedMatrix:
    """A 4x4 matrix from a text file.

    The matrix is validated on conversion to a pose or camera.
    """

    where: str  # file, and line in a file with several matrices
    values: Float64  # (4, 4), may be NaN

    def pose(self) -> Float64:
        """Return the nearest rigid transform (4, 4).

        Raises:
            DataError: The matrix is not a rigid transform.
        """
        with errors_of(self.where):
            return nearest_rigid(self.values)

    def stored_pose(self) -> Float64:
        """Return the nearest rigid transform (4, 4), or the nearest mirrored one if the determinant is negative.

        Raises:
            DataError: The matrix is neither of them.
        """
        if not np.isfinite(self.values).all() or float(np.linalg.det(self.values[:3, :3])) >= 0:
            return self.pose()
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        with errors_of(self.where):
            return nearest_rigid(self.values @ mirror) @ mirror

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera with this intrinsic matrix and the given image size, px.

        Raises:
            DataError: The matrix is not an intrinsic matrix.
        """
        (fx, _, cx, _), (_, fy, cy, _) = self.values[:2].tolist()
        if not np.allclose(self.values, [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]]):
            found = " / ".join(" ".join(f"{value:g}" for value in row) for row in self.values)
            expected = "expected intrinsics fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0 / 0 0 0 1"
            raise DataError(f"{self.where}: {expected}, got {found}")
        with errors_of(self.where):
            return Camera(width, height, fx, fy, cx, cy)


def read_matrix(path: Path) -> PrintedMatrix:
    """Read a 4x4 matrix from a file with four lines of four numbers.

    Raises:
        DataError: A line is invalid.
    """
    lines = _numbered_lines(path)
    if len(lines) != 4:
        raise DataError(f"{path}: expected 4 lines of 4 numbers, got {len(lines)} lines")
    return PrintedMatrix(str(path), np.array([numbers(where, words, 4) for where, words in lines]))


def read_matrix_lines(path: Path) -> list[PrintedMatrix]:
    """Read 4x4 matrices from a file with one matrix (16 numbers, row-major) per line.

    Raises:
        DataError: A line is invalid.
    """
    lines = _numbered_lines(path)
    return [PrintedMatrix(where, np.array(numbers(where, words, 16)).reshape(4, 4)) for where, words in lines]


def _numbered_lines(path: Path) -> list[tuple[str, list[str]]]:
    """Return the location, for messages, and the words of each nonempty line."""
    return [(f"{path}, line {n}", line.split()) for n, line in enumerate(read_lines(path), start=1) if line.strip()]
