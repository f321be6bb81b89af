"""Reading of timings.csv, the time of each stage for each frame."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Float64, Int64
from framework.errors import DataError
from framework.files.atomic_write import read_text
from framework.files.manifest import verified

HEADER = ["frame", "stage", "milliseconds"]
HEADER_SIZE = len(",".join(HEADER)) + 1  # bytes, with the end of the line
MAX_FRAME = 2**53  # limit of frame numbers; smaller integers are exact in float64


@dataclass(frozen=True)
class StageTimes:
    """The stage times of a run with F frames."""

    frames: Int64  # (F,) frame numbers, ascending
    milliseconds: Mapping[str, Float64]  # (F,) by stage, NaN = stage not run, e.g. integration of a lost frame


def read_timings(path: Path) -> StageTimes:
    """Read the stage times of a run.

    Raises:
        DataError: The file cannot be read, is invalid or contains no times.
    """
    try:
        with verified(path):
            lines = list(csv.reader(read_text(path).splitlines(keepends=True)))
    except csv.Error as error:
        raise DataError(f"{path}: expected valid CSV, got an error ({error})") from error
    if lines[:1] != [HEADER]:
        raise DataError(f"{path}, line 1: expected {','.join(HEADER)}, got {','.join(next(iter(lines), []))!r:.60}")
    taken: dict[tuple[int, str], float] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            frame, stage, milliseconds = int(line[0]), line[1], float(line[2])
        except (ValueError, IndexError):
            frame, stage, milliseconds = 0, "", np.nan
        if not (0 <= milliseconds < np.inf and abs(frame) < MAX_FRAME):
            raise DataError(f"{path}, line {number}: expected a frame, a stage and a time, got {','.join(line)!r:.60}")
        taken[frame, stage] = milliseconds
    if not taken:
        raise DataError(f"{path}: expected at least one time, got none")
    frames = sorted({frame for frame, _ in taken})
    stages = dict.fromkeys(stage for _, stage in taken)
    return StageTimes(
        np.array(frames, np.int64),
        {stage: np.array([taken.get((frame, stage), np.nan) for frame in frames], np.float64) for stage in stages},
    )
