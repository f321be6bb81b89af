"""The camera of a recording as a JSON object, whose keys each format names in its own way."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import COARSEST_DEPTH, FINEST_DEPTH
from framework.errors import DataError
from framework.files.atomic_write import MOST_TEXT
from framework.files.json_file import read_json

CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")  # of camera.json
DISTORTION = "distortion"  # the key of the lens distortion

log = logging.getLogger(__name__)


def read_json_object(path: Path, most: int = MOST_TEXT) -> dict[str, Any]:
    """The JSON object that a file of at most so many bytes holds. Raises DataError, naming it, when it holds none."""
    found = read_json(path, most)
    if not isinstance(found, dict):
        raise DataError(f"{path} must hold a JSON object, found {type(found).__name__}")
    return found


def camera_of(path: Path, content: Mapping[str, Any], keys: Sequence[str]) -> tuple[Camera, float]:
    """The camera and the depth scale (units per metre) that `content` of the file `path` gives.

    `keys` are the names of width, height, fx, fy, cx, cy and of the depth scale. Raises DataError, naming the file and
    the key, when a value is missing or cannot be.
    """
    values = [_number(path, content, key) for key in keys]
    for key, value in zip(keys[:2], values[:2], strict=True):
        if value != int(value):
            raise DataError(f"{path}: {key} must be a whole number of pixels, found {value}")
    width, height, fx, fy, cx, cy, depth_scale = values
    if not COARSEST_DEPTH <= depth_scale <= FINEST_DEPTH:
        raise DataError(
            f"{path}: {keys[-1]} must be in [{COARSEST_DEPTH:g}, {FINEST_DEPTH:g}], as metres = value / {keys[-1]} "
            f"(1000 for millimetres), found {depth_scale:g}"
        )
    try:
        return Camera(int(width), int(height), fx, fy, cx, cy), depth_scale
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def check_keys(path: Path, content: Mapping[str, Any], known: Sequence[str]) -> None:
    """Says in the log which keys of `content` of the file `path` are not read, as they are none of the `known`.

    Raises DataError for one that is nearly a known one: a misspelt lens distortion would be left out without a word.
    """
    unread = [key for key in content if key not in known]
    for key in unread:
        close = get_close_matches(key.lower(), known, n=1, cutoff=0.8)
        if close:
            raise DataError(f"{path}: there is no key {key!r}; did you mean {close[0]!r}?")
    if unread:
        log.warning("%s: not read: %s; its keys are %s", path, ", ".join(unread), ", ".join(known))


def distortion_of(path: Path, content: Mapping[str, Any]) -> Distortion | None:
    """The lens distortion that `content` of the file `path` gives, None without one. Raises DataError."""
    if DISTORTION not in content:
        return None
    values = content[DISTORTION]
    if not isinstance(values, list) or len(values) != len(fields(Distortion)):
        raise DataError(f"{path}: distortion must be [k1, k2, p1, p2, k3], found {str(values)[:60]}")
    named = {f"distortion[{k}]": value for k, value in enumerate(values)}
    return Distortion(*(_number(path, named, key) for key in named))


def _number(path: Path, content: Mapping[str, Any], key: str) -> float:
    if key not in content:
        raise DataError(f"{path}: the key {key!r} is missing")
    value = content[key]
    if not isinstance(value, bool) and isinstance(value, int | float) and math.isfinite(value):
        return float(value)
    raise DataError(f"{path}: {key} must be a number, found {str(value)[:40]!r}")
