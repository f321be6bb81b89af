"""SceneNN's timestamp.txt: a line a frame, its number (from 1) and when colour and depth were taken, microseconds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import written_whole
from framework.files.number_lines import SHOWN, read_lines

MICROSECONDS = 1e6  # a second


def read_timestamps(path: Path) -> Mapping[int, float]:
    """When each image was taken, s, by its number: the time of its depth, which is what is mapped.

    Raises DataError, naming file and line, when a line does not hold a number and two times, or has an earlier number.
    """
    times: dict[int, float] = {}
    for number, line in enumerate(read_lines(path), start=1):
        words = line.split()
        if not words:
            continue
        try:
            image, _color, depth = int(words[0]), *map(float, words[1:])
        except ValueError as error:
            expected = f"expected `number colour_us depth_us`, found {line[:SHOWN]!r}"
            raise DataError(f"{path}, line {number}: {expected}") from error
        if not math.isfinite(depth):
            raise DataError(f"{path}, line {number}: the time is not finite")
        if image in times:
            raise DataError(f"{path}, line {number}: image {image} is there twice")
        times[image] = depth / MICROSECONDS
    return times


def write_timestamps(path: Path, times: Mapping[int, float], color_times: Mapping[int, float] | None = None) -> None:
    """Writes the time in s of each image, by its number, whole or not at all.

    `times` are those of depth, and of colour as well where it has none of its own.
    """
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for number, time in times.items():
            color_time = time if color_times is None else color_times[number]
            file.write(f"{number} {round(color_time * MICROSECONDS)} {round(time * MICROSECONDS)}\n")
