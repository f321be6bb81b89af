"""4x4 matrices in text files, as datasets publish poses: one a file (four lines of four numbers), or one a line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64
from framework.errors import DataError, errors_of
from framework.files.number_lines import numbers, read_lines
from framework.geometry import nearest_rigid


@dataclass(frozen=True)
class PrintedMatrix:
    """A matrix as it stands in a file; what its numbers mean is only checked when that is asked for."""

    where: str  # file, and line where it has many
    values: Float64  # (4, 4), may be NaN

    def pose(self) -> Float64:
        """The rigid (4, 4) motion that it means. Raises DataError, naming the place, when it is none."""
        with errors_of(self.where):
            return nearest_rigid(self.values)

    def camera(self, width: int, height: int) -> Camera:
        """The pinhole camera that it means, for images of this size. Raises DataError, naming the place."""
        (fx, _, cx, _), (_, fy, cy, _) = self.values[:2].tolist()
        if not np.allclose(self.values, [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]]):
            raise DataError(f"{self.where}: expected intrinsics, fx 0 cx 0 / 0 fy cy 0 / 0 0 1 0 / 0 0 0 1")
        with errors_of(self.where):
            return Camera(width, height, fx, fy, cx, cy)


def read_matrix(path: Path) -> PrintedMatrix:
    """The matrix of a file. Raises DataError, naming file and line, unless it holds four lines of four numbers."""
    lines = _lines(path)
    if len(lines) != 4:
        raise DataError(f"{path}: expected 4 lines of 4 numbers, found {len(lines)} lines")
    return PrintedMatrix(str(path), np.array([numbers(f"{path}, line {n}", words, 4) for n, words in lines]))


def read_matrix_lines(path: Path) -> list[PrintedMatrix]:
    """The matrix of each line. Raises DataError, naming file and line, when one does not hold 16 numbers."""
    places = [(f"{path}, line {n}", words) for n, words in _lines(path)]
    return [PrintedMatrix(where, np.array(numbers(where, words, 16)).reshape(4, 4)) for where, words in places]


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """The words of each line that is not empty, with its number in the file, from 1."""
    return [(n, line.split()) for n, line in enumerate(read_lines(path), start=1) if line.strip()]
