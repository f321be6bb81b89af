"""Offset of the world frame for poses far from the origin, such as UTM coordinates.

Maps have float32 coordinates, which resolve 0.5 m at 5000 km. The offset is subtracted from all poses of a recording.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from framework.config.validation import require
from framework.data import Float64
from framework.geometry import FARTHEST

KEY = "dataset.world_offset"
ORIGIN = "map.origin."  # prefix of the figures x, y, z of a run
AUTO = "AUTO"
GRID = 1000.0  # m, AUTO offsets are multiples of it
LARGEST = 1e8  # m, maximum offset


def world_offset_of(parameter: str, positions: Float64) -> Float64:
    """Return the offset (3,) of the origin of the mapped world frame in the world frame of the recording, m.

    AUTO is 0 if the median position is within FARTHEST of the origin. Otherwise, it is the median position, rounded to
    multiples of GRID.

    Args:
        parameter: AUTO, or three numbers "x y z", m.
        positions: Camera positions (P, 3) in the world frame of the recording, m.

    Raises:
        ConfigError: The parameter is invalid.
    """
    if parameter != AUTO:
        return _parsed(parameter)
    if not len(positions):
        return np.zeros(3)
    middle = np.median(positions, axis=0)
    if not FARTHEST < np.linalg.norm(middle) < LARGEST:
        return np.zeros(3)
    return np.asarray(np.round(middle / GRID) * GRID)


def as_text(offset: Iterable[float]) -> str:
    """Return an offset (3,) as text, as in the parameter."""
    return " ".join(f"{value:.12g}" for value in offset)


def stored_origin(figures: Mapping[str, object]) -> tuple[float, ...]:
    """Return the origin of the map (3,) in the world frame of the recording, m, from the figures of a run; () = 0."""
    origin = tuple(float(str(figures.get(f"{ORIGIN}{axis}", 0.0))) for axis in "xyz")
    return origin if any(origin) else ()


def origin_comments(origin: Iterable[float]) -> list[str]:
    """Return an origin (3,) as a comment for the headers of files; [] = the origin is 0."""
    text = as_text(origin)
    return [f"origin of the map in the world frame of the recording, m: {text}"] if text.strip("0 ") else []


def as_setting(offset: Iterable[float]) -> str:
    """Return an offset (3,) as a setting for the command line."""
    return f'"{KEY}={as_text(offset)}"'


def _parsed(parameter: str) -> Float64:
    try:
        offset = np.array([float(word) for word in parameter.split()])
    except ValueError:
        offset = np.zeros(0)
    valid = offset.shape == (3,) and bool((np.abs(offset) <= LARGEST).all())
    require(valid, KEY, parameter, f'{AUTO} or three numbers "x y z" in [-{LARGEST:g}, {LARGEST:g}] m')
    return offset
