"""SceneNN's text files with poses, timestamps and intrinsics.

trajectory.log      per frame: a header of three integers, and the four rows of T_world_camera in meters
timestamp.txt       per frame: number (from 1), and timestamps of color and depth in microseconds
asus.ini            one key and value per line: fx, fy, cx, cy
"""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF8
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.data import Camera, Float64, check_rigid
from framework.errors import DataError
from framework.files.atomic_write import MAX_TEXT, atomic_write, read_bytes
from framework.files.number_lines import SHOWN, number, read_lines
from framework.geometry import nearest_rigid

LARGEST_FRAME = 2**31 - 2  # maximum frame number; frame + 1 must also fit into an int32
BLOCK = 5  # lines per frame
LAST_ROW = "0.000000 0.000000 0.000000 1.000000"  # as in the published files
MICROSECONDS = 1e6  # per second
INTRINSICS = ("fx", "fy", "cx", "cy")  # px
SIZES = {"cx": "depth_width", "cy": "depth_height"}  # px; half of the size replaces a missing principal point
POSITIVE = {"fx", "fy", *SIZES.values()}
LARGEST_INTRINSICS = 2**20  # bytes; an intrinsics file has a few hundred


@dataclass(frozen=True)
class TrajectoryLog:
    """The poses in a trajectory.log."""

    poses: Mapping[int, Float64]  # by frame, from 0: T_world_camera (4, 4), exactly rigid
    unusable: Mapping[int, str]  # by frame, from 0: reason (lost tracking, not finite, truncated, or repeated)


class _Line(NamedTuple):
    number: int  # line number in the file, from 1
    words: list[str]

    @property
    def shown(self) -> str:
        return repr(" ".join(self.words)[:60])


def read_trajectory_log(path: Path) -> TrajectoryLog:
    """Read the poses in a trajectory.log.

    A frame with two different poses is unusable. A truncated last frame is unusable too.

    Raises:
        DataError: A line is invalid for another reason.
    """
    content = read_bytes(path, MAX_TEXT).removeprefix(BOM_UTF8)
    numbered = (_Line(k, line.decode("latin-1").split()) for k, line in enumerate(content.splitlines(), start=1))
    lines = [line for line in numbered if line.words]
    poses: dict[int, Float64] = {}
    unusable: dict[int, str] = {}
    given: dict[int, tuple[int, Float64]] = {}  # line and matrix of each frame
    for first in range(0, len(lines), BLOCK):
        header, *rows = lines[first : first + BLOCK]
        at_end = first + BLOCK >= len(lines)
        cut = at_end and not rows  # the file ends within the header or after it
        if cut and len(header.words) == 1 and _is_frame(header.words[0]):
            break  # the frame number itself may be truncated
        if not 3 - cut <= len(header.words) <= 3 or not all(map(_is_frame, header.words)):
            expected = f"expected a frame header `frame frame frame+1`, got {header.shown}"
            raise DataError(f"{path}, line {header.number}: {expected}")
        frame = int(header.words[0])
        matrix = _matrix(path, rows, at_end)
        if frame in given:
            before, first_matrix = given[frame]
            if matrix is None or not np.array_equal(matrix, first_matrix, equal_nan=True):
                poses.pop(frame, None)
                lines_of_both = f"lines {before} and {header.number}"
                unusable[frame] = f"expected one pose, got different poses on {lines_of_both}"
            continue
        if matrix is None:
            unusable[frame] = "expected a full pose, got the end of the file"
            continue
        given[frame] = header.number, matrix
        try:
            poses[frame] = nearest_rigid(matrix)
        except DataError as error:
            unusable[frame] = str(error)
    return TrajectoryLog(poses, unusable)


def write_trajectory_log(path: Path, poses: Mapping[int, Float64]) -> None:
    """Write the pose T_world_camera (4, 4) of each frame to a trajectory.log.

    Raises:
        DataError: A frame number is negative, a pose is not rigid, or the file cannot be written.
    """
    lines = []
    for frame, T_world_camera in sorted(poses.items()):
        if not 0 <= frame <= LARGEST_FRAME:
            raise DataError(f"{path}: expected frame numbers from 0 to {LARGEST_FRAME}, got {frame}")
        check_rigid(f"{path}: frame {frame}: pose", T_world_camera)
        lines.append(f"{frame} {frame} {frame + 1}")
        lines.extend(" ".join(repr(float(value)) for value in row) for row in T_world_camera[:3])
        lines.append(LAST_ROW)
    with atomic_write(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in lines), encoding="ascii")


def _matrix(path: Path, rows: Sequence[_Line], at_end: bool) -> Float64 | None:
    """Return the matrix (4, 4) in four lines, or None if the file is truncated."""
    matrix = np.empty((4, 4))
    for k, line in enumerate(rows):
        try:
            numbers = [number(word) for word in line.words]
        except ValueError:
            numbers = []
        if len(numbers) == 4:
            matrix[k] = numbers
        elif at_end and k == len(rows) - 1 and len(line.words) <= 4:
            return None
        else:
            expected = f"expected row {k + 1} of a 4x4 matrix (four numbers), got {line.shown}"
            raise DataError(f"{path}, line {line.number}: {expected}")
    return matrix if len(rows) == 4 else None


def _is_frame(word: str) -> bool:
    """Return True if a word is a valid number for a frame header."""
    return word.isascii() and word.isdigit() and len(word) < 11 and int(word) <= LARGEST_FRAME + 1


def read_timestamps(path: Path) -> Mapping[int, tuple[float, float]]:
    """Read the timestamps of color and depth, s, by image number.

    Raises:
        DataError: A line is invalid, or an image number is repeated.
    """
    times: dict[int, tuple[float, float]] = {}
    for n, line in enumerate(read_lines(path), start=1):
        words = line.split()
        if not words:
            continue
        try:
            image, color, depth = int(words[0]), *map(float, words[1:])
        except ValueError as error:
            expected = f"expected `number color_us depth_us`, got {line[:SHOWN]!r}"
            raise DataError(f"{path}, line {n}: {expected}") from error
        if not (math.isfinite(color) and math.isfinite(depth)):
            raise DataError(f"{path}, line {n}: expected finite timestamps, got {words[1]} {words[2]}")
        if image in times:
            raise DataError(f"{path}, line {n}: expected unique image numbers, got {image} twice")
        times[image] = color / MICROSECONDS, depth / MICROSECONDS
    return times


def write_timestamps(path: Path, times: Mapping[int, float], color_times: Mapping[int, float] | None = None) -> None:
    """Write the timestamps of color and depth of each image.

    Args:
        path: The file.
        times: The timestamps of depth by image number, s.
        color_times: The timestamps of color by image number, s; None = same as depth.
    """
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for image, time in times.items():
            color_time = time if color_times is None else color_times[image]
            file.write(f"{image} {round(color_time * MICROSECONDS)} {round(time * MICROSECONDS)}\n")


def read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    """Read fx, fy, cx, cy in px, from lines `key value`, `key = value` or `key: value`.

    Comments (# or ;), section headers and other keys are ignored. If cx or cy is missing, half of depth_width or
    depth_height is used, as in ethz-asl/scenenn_to_rosbag.

    Raises:
        DataError: A key is missing or repeated, or its value is not a valid number.
    """
    values: dict[str, float] = {}
    lines = read_bytes(path, LARGEST_INTRINSICS).removeprefix(BOM_UTF8).decode("latin-1").splitlines()
    for n, line in enumerate(lines, start=1):
        content = re.split("[#;]", line)[0].strip()
        key, text = (*re.split(r"\s*[=:]\s*|\s+", content.lower(), maxsplit=1), "")[:2]
        if key not in POSITIVE and key not in INTRINSICS:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key in POSITIVE and value <= 0):
            wanted = "a value > 0 px" if key in POSITIVE else "a finite value in px"
            raise DataError(f"{path}, line {n}: {key}: expected {wanted}, got {text[:40]!r}")
        if key in values:
            raise DataError(f"{path}, line {n}: {key}: expected one value, got {values[key]:g} and {value:g}")
        values[key] = value
    for center, size in SIZES.items():
        if size in values:
            values.setdefault(center, values[size] / 2)
    missing = [key for key in INTRINSICS if key not in values]
    if missing:
        raise DataError(f"{path}: expected values of {', '.join(INTRINSICS)}, got no {missing[0]}")
    return values["fx"], values["fy"], values["cx"], values["cy"]


def write_intrinsics(path: Path, camera: Camera) -> None:
    """Write the intrinsics of a camera in full precision."""
    sizes = {"depth_width": camera.width, "depth_height": camera.height}
    values = sizes | {key: getattr(camera, key) for key in INTRINSICS}
    with atomic_write(path) as temporary:
        temporary.write_text("".join(f"{key} {value!r}\n" for key, value in values.items()), encoding="ascii")
