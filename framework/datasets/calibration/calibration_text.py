"""Calibrations in text files of other programs.

300 0 158 / 0 301 121 / 0 0 1       a 3x3 intrinsic matrix, or a 4x4 matrix that contains it
300 301 158 121 k1 k2 p1 p2 k3      fx fy cx cy, with an optional distortion (calibration.txt of ETH3D and DROID-SLAM)
Camera.fx: 300                      keys fx, fy, cx, cy, and optionally k1, k2, p1, p2, k3 and a depth scale, as in
                                    YAML files of ORB-SLAM
camera_matrix: data: [300, 0 ...]   a list of nine numbers, as in camera_info of ROS, OpenCV's FileStorage and
                                    Open3D's intrinsic_matrix (column-major)
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64
from framework.datasets.calibration.undistortion import Distortion
from framework.errors import DataError, errors_of
from framework.files.number_lines import COMMENT, SHOWN, number, read_lines

KEYS = ("fx", "fy", "cx", "cy")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
SCALES = ("depth_scale", "depthmapfactor", "png_depth_scale")
MAX_ASPECT = 1.25  # maximum ratio of fx and fy in a file without keys; other orders of the four numbers have more

_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]+)?"
_VALUE = re.compile(rf"\b({'|'.join((*KEYS, *COEFFICIENTS, 'k4', *SCALES))})[\"']?\s*[:=]\s*({_NUMBER})", re.IGNORECASE)
_LIST = rf"[^\[]*\[((?:[\s\[\],]*{_NUMBER})+)[\s\[\],]*\]"
_MATRIX = re.compile(rf"\b(?:camera_matrix|intrinsic_matrix|intrinsics?|K)\b[\"']?\s*:{_LIST}", re.IGNORECASE)
_LENS = re.compile(rf"\b(?:distortion_coefficients|distortion_coeffs|dist_coeffs)\b[\"']?\s*:{_LIST}", re.IGNORECASE)
_OTHER_LENS = re.compile("kannala|fisheye|equidistant|rational", re.IGNORECASE)


@dataclass(frozen=True)
class TextCalibration:
    """Calibration in a text file, without the image size."""

    where: Path  # the file, for messages
    values: tuple[float, ...]  # (4,) fx, fy, cx, cy, px
    distortion: Distortion | None = None  # None = pinhole camera
    depth_scale: float | None = None  # units per meter; None = unknown

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera of images with the given size, px.

        Raises:
            DataError: The intrinsics are invalid.
        """
        fx, fy, cx, cy = self.values
        with errors_of(self.where):
            return Camera(width, height, fx, fy, cx, cy)


def read_calibration(path: Path) -> TextCalibration:
    """Read the calibration in a text file.

    Raises:
        DataError: The file has an unknown format.
    """
    text = "\n".join(COMMENT.sub("", line) for line in read_lines(path))
    try:
        values = [number(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return _named(path, text)
    if len(values) == 16 or values[6:] == [0, 0, 1]:
        return TextCalibration(path, intrinsics_of(path, np.reshape(values, (-1, 4 if len(values) == 16 else 3))))
    if len(values) in (4, 8, 9) and 1 / MAX_ASPECT <= values[0] / (values[1] or math.inf) <= MAX_ASPECT:
        return TextCalibration(path, tuple(values[:4]), _distortion(path, values[4:]))
    raise _unknown(path, f"{len(values)} numbers, {' '.join(f'{value:g}' for value in values)[:SHOWN]}")


def intrinsics_of(where: Path, K: Float64) -> tuple[float, ...]:
    """Return fx, fy, cx, cy of an intrinsic matrix (3, 3) or (4, 4), px.

    Raises:
        DataError: The matrix is not an intrinsic matrix.
    """
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    if not np.allclose(K[:3, :3], np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])):
        found = " / ".join(" ".join(f"{value:g}" for value in row) for row in K[:3, :3])
        raise DataError(f"{where}: expected intrinsics fx 0 cx / 0 fy cy / 0 0 1, got {found}")
    return fx, fy, cx, cy


def _named(path: Path, text: str) -> TextCalibration:
    """Return the calibration in a text with keys."""
    values: dict[str, float] = {}
    for key, value in _VALUE.findall(text):
        if values.setdefault(key.lower(), float(value)) != float(value):
            raise DataError(f"{path}: {key}: expected one value, got {values[key.lower()]:g} and {value}")
    if _OTHER_LENS.search(text) or values.get("k4"):
        raise _unknown(path, "another lens model")
    scale = next((values[key] for key in SCALES if key in values), None)
    matrix, lens = _MATRIX.search(text), _LENS.search(text)
    if all(key in values for key in KEYS):
        intrinsics = tuple(values[key] for key in KEYS)
        coefficients = [values.get(key, 0.0) for key in COEFFICIENTS]
    elif matrix and len(numbers := _numbers(matrix[1])) == 9:
        K = np.reshape(numbers, (3, 3))
        intrinsics = intrinsics_of(path, K.T if K[2, 0] else K)  # Open3D stores columns
        coefficients = _numbers(lens[1]) if lens else []
    else:
        raise _unknown(path, f"{' '.join(text.split())[:SHOWN]!r}")
    return TextCalibration(path, intrinsics, _distortion(path, coefficients), scale)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(_NUMBER, text, re.IGNORECASE)]


def _distortion(path: Path, coefficients: Sequence[float]) -> Distortion | None:
    if any(coefficients[5:]):
        raise _unknown(path, f"{len(coefficients)} distortion coefficients")
    return Distortion(*coefficients[:5]) if any(coefficients) else None


def _unknown(path: Path, found: str) -> DataError:
    expected = "expected a 3x3 intrinsic matrix, fx fy cx cy k1 k2 p1 p2 k3, or keys fx, fy, cx, cy"
    return DataError(f"{path}: {expected}, got {found}; write camera.json, which takes precedence, or move the file")
