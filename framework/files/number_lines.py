"""Text files with some numbers in each line, as datasets publish times and poses.

Hand-written, for np.loadtxt does not know Microsoft's NaN, and counts rows where a person looks for a line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import read_text

SHOWN = 60  # characters of what a file holds that an error repeats

_NO_NUMBER = re.compile(r"[+-]?(1\.#\w+|nan\(\w+\))", re.ASCII | re.IGNORECASE)


def read_lines(path: Path, missing: str = "does not exist") -> list[str]:
    """The lines of a text file. Raises DataError, naming it; `missing` is what is said of one that is not there."""
    if not path.exists():
        raise DataError(f"{path} {missing}")
    return read_text(path).splitlines()


def number(word: str) -> float:
    """The number that a word is; NaN for all that Microsoft's C library prints where there is none: -1.#IND, 1.#INF.

    Raises ValueError when it is none.
    """
    return math.nan if _NO_NUMBER.fullmatch(word) else float(word)


def numbers(where: str, words: Sequence[str], count: int, names: str = "") -> list[float]:
    """The words of a line as so many numbers, NaN among them. Raises DataError, naming the place, when they are not.

    `names` are what the numbers are called.
    """
    expected = f"{where}: expected {count} numbers{f' ({names})' if names else ''}"
    if len(words) != count:
        raise DataError(f"{expected}, found {len(words)}")
    values = []
    for word in words:
        try:
            values.append(number(word))
        except ValueError as error:
            raise DataError(f"{expected}, found {word[:SHOWN]!r}") from error
    return values
