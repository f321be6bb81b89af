"""Poses in a folder with one text file per frame, as ScanNet and BundleFusion write them.

pose/000000.txt     16 or 12 numbers: T_world_camera, row-major; only zeros = unknown
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.datasets.frames.numbered_images import numbered_images
from framework.errors import DataError
from framework.files.number_lines import PrintedMatrix, numbers, read_lines

POSE_FOLDERS = ("pose", "poses")
SIZES = (16, 12)  # numbers of a 4x4 matrix, and of its first three rows

log = logging.getLogger(__name__)


def read_pose_folder(folder: Path, frames: Sequence[int]) -> list[Callable[[], Float64 | None]] | None:
    """Return the pose of each frame from the pose folder of a recording, or None without such a folder.

    The functions return T_world_camera (4, 4), or None if it is unknown. They raise DataError if the pose is invalid.

    Args:
        folder: The folder of the recording.
        frames: The frame numbers.

    Raises:
        DataError: The names are invalid, or no file belongs to a frame.
    """
    found = next((folder / name for name in POSE_FOLDERS if (folder / name).is_dir()), None)
    if found is None:
        return None
    files = numbered_images(found, (".txt",))
    matrices = [_read(files[number]) if number in files else None for number in frames]
    known = sum(matrix is not None for matrix in matrices)
    if not files.keys() & set(frames):
        first = next(iter(files.values())).name
        raise DataError(f"{found}: expected a pose of frame {frames[0]}, got {len(files)} files from {first}")
    log.info("%s: read T_world_camera of %d of %d frames", found, known, len(frames))
    return None if known == 0 else [_pose_of(matrix) for matrix in matrices]


def _pose_of(matrix: PrintedMatrix | DataError | None) -> Callable[[], Float64 | None]:
    def pose() -> Float64 | None:
        if isinstance(matrix, DataError):
            raise matrix
        return None if matrix is None else matrix.stored_pose()

    return pose


def _read(path: Path) -> PrintedMatrix | DataError | None:
    """Return the matrix in a file, None if it contains only zeros, or the error of an invalid file."""
    try:
        words = " ".join(read_lines(path)).split()
        if len(words) not in SIZES:
            raise DataError(f"{path}: expected 16 or 12 numbers of T_world_camera, got {len(words)}")
        values = np.array(numbers(str(path), words, len(words))).reshape(-1, 4)
    except DataError as error:
        return error
    if not values[:3].any():
        return None
    return PrintedMatrix(str(path), values if len(values) == 4 else np.vstack([values, [0, 0, 0, 1]]))
