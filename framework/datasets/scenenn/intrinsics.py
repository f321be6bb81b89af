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
SIZES = {"cx": "depth_width", "cy": "depth_height"}  # px, whose half replaces a missing center
POSITIVE = {"fx", "fy", *SIZES.values()}
LARGEST_FILE = 2**20  # bytes; such a file has some hundred


def read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in px, from lines `key value`, `key = value` or `key: value`.

    Keys may be in upper case; comments (# or ;), section headers and other keys are ignored. Without cx or cy, half of
    depth_width or depth_height is used, as in ethz-asl/scenenn_to_rosbag. Raises DataError, with the file and the line,
    if a key is missing or repeated, or its value is not finite, or not positive for focal lengths and sizes.
    """
    values: dict[str, float] = {}
    lines = read_bytes(path, LARGEST_FILE).removeprefix(BOM_UTF8).decode("latin-1").splitlines()
    for number, line in enumerate(lines, start=1):
        key, _, text = re.sub(r"\s*[=:]\s*|\s+", "\0", re.split("[#;]", line)[0].strip(), count=1).partition("\0")
        key = key.lower()
        if key not in POSITIVE and key not in KEYS:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key in POSITIVE and value <= 0):
            wanted = "a positive number" if key in POSITIVE else "a number"
            raise DataError(f"{path}, line {number}: {key} must be {wanted} of pixels, found {text[:40]!r}")
        if key in values:
            raise DataError(f"{path}, line {number}: {key} is there a second time")
        values[key] = value
    for center, size in SIZES.items():
        if size in values:
            values.setdefault(center, values[size] / 2)
    missing = [key for key in KEYS if key not in values]
    if missing:
        raise DataError(f"{path} has no line with {missing[0]}; it must give {', '.join(KEYS)}")
    return values["fx"], values["fy"], values["cx"], values["cy"]


def write_intrinsics(path: Path, camera: Camera) -> None:
    """Write the camera's intrinsics atomically, without loss of digits."""
    sizes = {"depth_width": camera.width, "depth_height": camera.height}
    values = sizes | {key: getattr(camera, key) for key in KEYS}
    with written_whole(path) as temporary:
        temporary.write_text("".join(f"{key} {value!r}\n" for key, value in values.items()), encoding="ascii")
