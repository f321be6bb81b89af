"""Columns of trajectories, in the order of a format or as named by a header.

Headers differ in their names and in the order of the quaternion, for example:

    # timestamp tx ty tz qx qy qz qw
    #timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []
    timestamp,x,y,z,qw,qx,qy,qz
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from framework.files.number_lines import COMMENT

SEPARATORS = (",", ";")  # other than spaces and tabs
NANOSECOND = 1e-9  # s

_UNITS = {"ns": NANOSECOND, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_TIME = re.compile(r"(?:time|timestamp|time_stamp|stamp|t)(?:_?(ns|us|ms|s)(?:ec\w*)?)?")
_POSITION = re.compile(r"(?:(?:.*_)?(?:t|p|pos|position|trans|translation)(?:_rs_r)?_?)?([xyz])")
_QUATERNION = re.compile(r"(?:.*_)?(?:q|quat|quaternion|orientation|rot|rotation)(?:_rs)?_?([xyzw])")


@dataclass(frozen=True)
class Columns:
    """Indices of the columns of a trajectory, from 0."""

    time: int
    position: tuple[int, ...]  # (3,)
    quat_xyzw: tuple[int, ...]  # (4,)
    count: int  # minimum number of columns
    time_unit: float | None = 1.0  # s, None = unknown

    @property
    def order(self) -> str:
        """Order of the components of the quaternion."""
        return " ".join(name for _, name in sorted(zip(self.quat_xyzw, "xyzw", strict=True)))

    def __str__(self) -> str:
        unit = next((name for name, unit in _UNITS.items() if unit == (self.time_unit or 1.0)), self.time_unit)
        return f"times in {unit} and quaternions {self.order}"

    def chosen(self, words: Sequence[str]) -> list[str]:
        """Return the words of a line in the order timestamp tx ty tz qx qy qz qw."""
        return [words[k] for k in (self.time, *self.position, *self.quat_xyzw)]


TUM = Columns(0, (1, 2, 3), (4, 5, 6, 7), 8)
EUROC = Columns(0, (1, 2, 3), (5, 6, 7, 4), 8, NANOSECOND)


def words_of(line: str) -> list[str]:
    """Return the words between the commas, semicolons or spaces of a line."""
    separator = next((one for one in SEPARATORS if one in line), None)
    return [word.strip() for word in line.split(separator)]


def without_header(lines: Sequence[str]) -> tuple[Columns | None, list[tuple[int, str]]]:
    """Return the columns named by a header, or None, and the other lines with their numbers, without comments."""
    columns: Columns | None = None
    rows: list[tuple[int, str]] = []
    for number, line in enumerate(lines, start=1):
        named = None if rows else named_columns(line)
        columns = named or columns
        text = "" if named else COMMENT.sub("", line).strip()
        if text:
            rows.append((number, text))
    return columns, rows


def named_columns(header: str) -> Columns | None:
    """Return the columns named by a header, or None if it does not name the time, the position and the quaternion."""
    units = re.findall(r"[\[(]\s*([nmu]?s)(?:ec\w*)?\s*[\])]", header.lower())
    plain = re.sub(r"\[.*?\]|\(.*?\)", " ", header.lower().lstrip("#%/ \t"))
    names = [re.sub(r"[^a-z0-9]+", "_", word).strip("_") for word in words_of(plain)]
    times = {k: match for k, name in enumerate(names) if (match := _TIME.fullmatch(name))}
    position = _indices(names, _POSITION)
    quaternion = _indices(names, _QUATERNION)
    if not times or position.keys() != set("xyz") or quaternion.keys() != set("xyzw"):
        return None
    time, match = next(iter(times.items()))
    unit = _UNITS[match[1]] if match[1] else _UNITS[units[0]] if units else None
    if unit is None and "rs_" in header.lower():  # published files of EuRoC without units
        unit = NANOSECOND
    return Columns(time, tuple(position[a] for a in "xyz"), tuple(quaternion[a] for a in "xyzw"), len(names), unit)


def _indices(names: Sequence[str], pattern: re.Pattern[str]) -> dict[str, int]:
    """Return the index of the first name of each axis."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        if match := pattern.fullmatch(name):
            found.setdefault(match[1], k)
    return found
