"""NPY files, and instance masks as NPY or text files."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from framework.data import Int32
from framework.errors import DataError, reason_of
from framework.files.atomic_write import read_bytes, read_text

LARGEST_FILE = 2**32  # bytes

Numbers = npt.NDArray[Any]


def read_array(path: Path) -> Numbers:
    """Read the array in an NPY file. Pickled objects are rejected.

    Raises:
        DataError: The file is missing or damaged.
    """
    content = read_bytes(path, LARGEST_FILE)
    try:
        return np.lib.format.read_array(BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, MemoryError, OverflowError) as error:
        raise DataError(f"{path}: expected an NPY file, got an error ({reason_of(error)})") from error


def read_mask(path: Path, points: int) -> Int32:
    """Return the ascending indices (M,) of the points of an instance mask.

    A text file has one number for each point, nonzero = part of the instance (ScanNet). An NPY file contains one
    Boolean or 0/1 value for each point, or the indices of the points.

    Args:
        path: The file, .npy or text.
        points: The number of points of the map.

    Raises:
        DataError: The file is missing, damaged, or does not match the number of points.
    """
    if path.suffix.lower() != ".npy":
        return _of_flags(path, _numbers(path), points)
    values = read_array(path)
    if values.ndim == 2 and 1 in values.shape:
        values = values.reshape(-1)
    if values.ndim != 1 or values.dtype.kind not in "biu":
        raise DataError(f"{path}: expected Booleans or integers (V,), got {values.dtype} {values.shape}")
    if values.dtype.kind == "b" or (len(values) == points and np.isin(values, (0, 1)).all()):
        return _of_flags(path, values, points)
    return _of_indices(path, values, points)


def _numbers(path: Path) -> Numbers:
    words = read_text(path, LARGEST_FILE).split()
    try:
        return np.array(words, np.float64)
    except ValueError as error:
        raise DataError(f"{path}: expected one number for each point, got an error ({error})") from error


def _of_flags(path: Path, flags: Numbers, points: int) -> Int32:
    if len(flags) != points:
        raise DataError(f"{path}: expected {points} values, one for each point of the map, got {len(flags)}")
    return np.flatnonzero(flags).astype(np.int32)


def _of_indices(path: Path, indices: Numbers, points: int) -> Int32:
    if len(indices) and (indices.min() < 0 or indices.max() >= points):
        raise DataError(
            f"{path}: expected indices of points in [0, {points}), got {indices.min()} to {indices.max()}; a mask "
            f"needs {points} values"
        )
    return np.unique(indices).astype(np.int32)
