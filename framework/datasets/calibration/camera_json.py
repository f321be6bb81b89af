"""Camera calibrations in JSON files."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from framework.data import Camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.conventions import check_depth_scale
from framework.errors import DataError, errors_of
from framework.files.atomic_write import MAX_TEXT, read_bytes
from framework.files.json_file import parse_json
from framework.sensors.noise_models import SensorKind

CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")  # of camera.json
DISTORTION = "distortion"  # key of the lens distortion
SENSOR = "sensor"  # key of the kind of the depth sensor

log = logging.getLogger(__name__)


class StoredCamera(NamedTuple):
    """Calibration of a recording."""

    camera: Camera
    depth_scale: float  # units per meter
    distortion: Distortion | None  # lens distortion of color and depth; None = pinhole camera
    sensor: SensorKind = SensorKind.KINECT_V1


def read_json_object(path: Path, most: int = MAX_TEXT) -> dict[str, Any]:
    """Read the JSON object in a file.

    Args:
        path: The JSON file.
        most: The maximum size of the file, bytes.

    Raises:
        DataError: The file cannot be read, is too large or contains no JSON object.
    """
    return json_object(path, read_bytes(path, most))


def json_object(path: Path, content: bytes) -> dict[str, Any]:
    """Return the JSON object in the content of a file.

    Raises:
        DataError: The content is no JSON object. The message contains the path.
    """
    found = parse_json(path, content)
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a JSON object, got {type(found).__name__}")
    return found


def read_camera(path: Path) -> StoredCamera:
    """Read the calibration in a camera.json.

    Raises:
        DataError: The file is invalid, or a key is missing or has an invalid value.
    """
    return stored_camera(path, read_json_object(path))


def stored_camera(path: Path, content: Mapping[str, Any]) -> StoredCamera:
    """Return the calibration in the content of a camera.json.

    Raises:
        DataError: A key is missing or has an invalid value.
    """
    check_keys(path, content, (*CAMERA_KEYS, DISTORTION, SENSOR))
    camera = camera_of(path, content, CAMERA_KEYS)
    return StoredCamera(*camera, distortion_of(path, content), sensor_of(path, content))


def camera_of(path: Path, content: Mapping[str, Any], keys: Sequence[str]) -> tuple[Camera, float]:
    """Return the camera and the depth scale (units per meter) in the content of a JSON file.

    Args:
        path: The file, for error messages.
        content: The JSON object in the file.
        keys: The keys of this file format, in the order of CAMERA_KEYS.

    Raises:
        DataError: A key is missing or has an invalid value.
    """
    *camera, depth_scale = numbers_of(path, content, *keys)
    check_depth_scale(f"{path}: {keys[-1]}", depth_scale)
    return pinhole(path, *camera), depth_scale


def pinhole(where: Path | str, width: float, height: float, fx: float, fy: float, cx: float, cy: float) -> Camera:
    """Return a pinhole camera.

    The image size and the intrinsics are in px.

    Raises:
        DataError: The image size or the intrinsics are invalid. The message contains `where`.
    """
    if not (width % 1 == 0 and height % 1 == 0):  # False for NaN and infinity
        raise DataError(f"{where}: width, height: expected whole numbers of px, got {width:g}x{height:g}")
    with errors_of(where):
        return Camera(int(width), int(height), fx, fy, cx, cy)


def check_keys(path: Path, content: Mapping[str, Any], known: Sequence[str]) -> None:
    """Log a warning for unknown keys.

    Raises:
        DataError: An unknown key is similar to a known key and is probably misspelled.
    """
    unread = [key for key in content if key not in known]
    for key in unread:
        close = get_close_matches(key.lower(), known, n=1, cutoff=0.8)
        if close:
            raise DataError(f"{path}: expected a known key, got {key!r}; did you mean {close[0]!r}?")
    if unread:
        log.warning("%s: ignored unknown keys: %s; known keys: %s", path, ", ".join(unread), ", ".join(known))


def number_list(where: Path | str, values: Any, count: int) -> list[float]:
    """Return a JSON list of numbers as floats.

    Raises:
        DataError: `values` is not a list of `count` finite numbers.
    """
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise DataError(f"{where}: expected a list of {count} numbers, got {values!r:.60}")
    return [float(value) for value in values]


def numbers_of(where: Path | str, content: Mapping[str, Any], *keys: str) -> list[float]:
    """Return the values of several keys as floats.

    Raises:
        DataError: A key is missing, or its value is not a finite number.
    """
    for key in keys:
        if key not in content:
            raise DataError(f"{where}: expected a key {key!r}, got none")
        if not _is_number(content[key]):
            raise DataError(f"{where}: {key}: expected a number, got {content[key]!r:.40}")
    return [float(content[key]) for key in keys]


def distortion_of(path: Path, content: Mapping[str, Any]) -> Distortion | None:
    """Return the lens distortion in the content of a camera.json.

    The result is None for a pinhole camera, i.e. without the key.

    Raises:
        DataError: The value is not a list of five finite numbers.
    """
    if DISTORTION not in content:
        return None
    return Distortion(*number_list(f"{path}: distortion [k1, k2, p1, p2, k3]", content[DISTORTION], 5))


def sensor_of(path: Path, content: Mapping[str, Any]) -> SensorKind:
    """Return the kind of the depth sensor in the content of a camera.json.

    The default is KINECT_V1.

    Raises:
        DataError: The value is not the name of a SensorKind.
    """
    name = content.get(SENSOR, SensorKind.KINECT_V1.name)
    if not isinstance(name, str) or name not in SensorKind.__members__:
        raise DataError(
            f"{path}: {SENSOR}: expected one of {', '.join(SensorKind.__members__)}, got {str(name)[:40]}; set the "
            "kind of the depth sensor, or remove the key for KINECT_V1"
        )
    return SensorKind[name]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
