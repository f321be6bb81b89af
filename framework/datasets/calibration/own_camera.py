"""Calibration of a recording in the layout of a published dataset, from a file next to its images."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np

from framework.data import Camera
from framework.datasets.calibration.camera_json import StoredCamera, read_camera
from framework.errors import DataError, FrameError, errors_of
from framework.files.atomic_write import path_exists
from framework.files.image_files import read_color
from framework.files.number_lines import COMMENT, number, read_lines

CAMERA_JSON = "camera.json"
INTRINSICS = ("camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsics.txt", "intrinsic.txt")
"""Text files with a 3x3 intrinsic matrix, or a 4x4 matrix that contains it."""


def own_camera(folder: Path, color: Iterable[Path], depth_scale: float) -> tuple[StoredCamera, Path] | None:
    """Return the calibration in a folder and its file, or None without such a file.

    A camera.json takes precedence over a text file.

    Args:
        folder: The folder.
        color: The color images. With a text file, they define the image size.
        depth_scale: The depth scale of the layout, units per meter, for text files.

    Raises:
        DataError: The file is invalid.
    """
    if path_exists(folder / CAMERA_JSON):
        return read_camera(folder / CAMERA_JSON), folder / CAMERA_JSON
    for name in INTRINSICS:
        if path_exists(folder / name):
            return StoredCamera(_read_intrinsics(folder / name, color), depth_scale, None), folder / name
    return None


def _read_intrinsics(path: Path, color: Iterable[Path]) -> Camera:
    words = [COMMENT.sub("", line).replace(",", " ").split() for line in read_lines(path)]
    try:
        values = np.array([number(word) for line in words for word in line])
    except ValueError as error:
        raise DataError(f"{path}: expected a 3x3 intrinsic matrix, got other text ({error})") from error
    if len(values) not in (9, 16):
        raise DataError(f"{path}: expected a 3x3 intrinsic matrix, got {len(values)} numbers")
    side = 3 if len(values) == 9 else 4
    K = values.reshape(side, side)[:3, :3]
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    if not np.allclose(K, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])):
        found = " / ".join(" ".join(f"{value:g}" for value in row) for row in K)
        raise DataError(f"{path}: expected intrinsics fx 0 cx / 0 fy cy / 0 0 1, got {found}")
    height, width = _size(path, color)
    with errors_of(path):
        return Camera(width, height, fx, fy, cx, cy)


def _size(path: Path, color: Iterable[Path]) -> tuple[int, int]:
    """Return the height and width of the first readable color image, px."""
    for image in color:
        with suppress(FrameError):
            height, width, _ = read_color(image).shape
            return height, width
    raise DataError(f"{path}: expected a readable color image for the image size, got none; write {CAMERA_JSON}")
