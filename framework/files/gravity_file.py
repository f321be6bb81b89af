"""Which way is up in the camera of each frame, as a sensor told: a line a frame, `x y z`, in the camera's axes.

The vector points against gravity, and need not have length 1: an accelerometer at rest measures it. `nan nan nan` = not
known in this frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.errors import DataError
from framework.files.atomic_write import written_whole
from framework.files.number_lines import numbers, read_lines
from framework.files.tum_trajectory import COMMENT

COLUMNS = "x y z"
SHORTEST, LONGEST = 1e-6, 1e6  # in whatever unit, that a direction is


def read_gravity(path: Path) -> list[Float64 | None]:
    """The unit vector (3,) of each line, None where it is not known; empty lines and what follows a `#` are skipped.

    Raises DataError, naming file and line, when one does not hold three numbers that are a direction, or three NaN.
    """
    words = [COMMENT.sub("", line).split() for line in read_lines(path)]
    return [_direction(f"{path}, line {n}", found) for n, found in enumerate(words, start=1) if found]


def write_gravity(path: Path, ups: Sequence[Float64 | None]) -> None:
    """Writes the vector (3,) of each frame, None = not known, whole or not at all; `read_gravity` gives them back."""
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for up in ups:
            file.write("nan nan nan\n" if up is None else " ".join(f"{value:.9f}" for value in up) + "\n")


def _direction(where: str, words: Sequence[str]) -> Float64 | None:
    values = numbers(where, words, len(COLUMNS.split()), COLUMNS)
    if all(map(math.isnan, values)):
        return None
    length = math.hypot(*values)
    if not SHORTEST <= length <= LONGEST:
        raise DataError(f"{where}: expected a direction, or nan nan nan where none is known, found {' '.join(words)!r}")
    return np.array(values) / length
