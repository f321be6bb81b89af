"""Numbers in the JSON files of apps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from framework.data import Camera
from framework.errors import DataError


def listed(where: Path | str, content: Mapping[str, Any], key: str, count: int) -> list[float]:
    """So many finite numbers under a key. Raises DataError, naming `where` and the key, when it holds others."""
    return finite(f"{where}: {key}", content.get(key), count)


def finite(where: str, values: Any, count: int) -> list[float]:
    """A list of so many finite numbers as it is. Raises DataError, naming `where`, when it is none."""
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise DataError(f"{where} must be a list of {count} numbers, found {str(values)[:60]}")
    return [float(value) for value in values]


def named(where: Path | str, content: Mapping[str, Any], *keys: str) -> list[float]:
    """The finite numbers under some keys. Raises DataError, naming `where` and the key, when one is missing."""
    for key in keys:
        if not _is_number(content.get(key)):
            raise DataError(f"{where}: {key} must be a number, found {str(content.get(key))[:60]}")
    return [float(content[key]) for key in keys]


def camera(where: Path | str, width: float, height: float, fx: float, fy: float, cx: float, cy: float) -> Camera:
    """Raises DataError, naming `where`, when there can be no such camera."""
    if width != int(width) or height != int(height):
        raise DataError(f"{where}: an image has whole numbers of pixels, found {width}x{height}")
    try:
        return Camera(int(width), int(height), fx, fy, cx, cy)
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
