"""SceneNN's intrinsics, such as asus.ini: lines of a key and a value."""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF8
from pathlib import Path

from framework.data import Camera
from framework.errors import DataError
from framework.files.atomic_write import read_bytes, written_whole

KEYS = ("fx", "fy", "cx", "cy")  # px
SIZES = {"cx": "depth_width", "cy": "depth_height"}  # px, whose middle is the centre where the file has none
POSITIVE = {"fx", "fy", *SIZES.values()}
LARGEST_FILE = 2**20  # bytes; such a file has some hundred


def read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in px, from lines `key value`, `key = value` or `key: value`.

    Keys may be in upper case; comments (# or ;), section headers and other keys are left out. Without cx or cy, it is
    half of depth_width or depth_height, as ethz-asl/scenenn_to_rosbag takes it. Raises DataError, naming file and line,
    when a key is missing, there twice, or its value is no finite number, positive for focal lengths and sizes.
    """
    values: dict[str, float] = {}
    lines = read_bytes(path, LARGEST_FILE).removeprefix(BOM_UTF8).splitlines()
    for number, line in enumerate(lines, start=1):
        content = re.split("[#;]", line.decode("latin-1"))[0].strip()
        key, *found = re.split(r"\s*[=:]\s*|\s+", content, maxsplit=1)
        key = key.lower()
        if key not in POSITIVE and key not in KEYS:
            continue
        value = _number(found[0] if found else "")
        if value is None or (key in POSITIVE and value <= 0):
            wanted = "a positive number" if key in POSITIVE else "a number"
            raise DataError(f"{path}, line {number}: {key} must be {wanted} of pixels, found {' '.join(found)[:40]!r}")
        if key in values:
            raise DataError(f"{path}, line {number}: {key} is there a second time")
        values[key] = value
    for center, size in SIZES.items():
        if center not in values and size in values:
            values[center] = values[size] / 2
    missing = [key for key in KEYS if key not in values]
    if missing:
        raise DataError(f"{path} has no line with {missing[0]}; it must give {', '.join(KEYS)}")
    return values["fx"], values["fy"], values["cx"], values["cy"]


def write_intrinsics(path: Path, camera: Camera) -> None:
    """Writes the camera's intrinsics, whole or not at all; `read_intrinsics` gives the same numbers back."""
    sizes = {"depth_width": camera.width, "depth_height": camera.height}
    values = sizes | {key: getattr(camera, key) for key in KEYS}
    with written_whole(path) as temporary:
        temporary.write_text("".join(f"{key} {value!r}\n" for key, value in values.items()), encoding="ascii")


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
