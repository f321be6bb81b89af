"""Folders of images with the number of their frame at the end of their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from framework.data import Array
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, FrameError


def numbered_images(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Return the folder's images by the number at the end of their names, in ascending order.

    Raises DataError if there is none, a name has no number, two have the same, or the names differ in other digits
    as well, such as the decimals of a time.
    """
    if not folder.is_dir():
        raise DataError(f"the folder {folder} is missing")
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        number = number_of(path)
        if number is None:
            raise DataError(f"{path}: the file name must end in the frame's number, like 000000{path.suffix}")
        if number in files:
            raise DataError(f"{path} and {files[number].name} have the same frame number {number}")
        files[number] = path
    check_one_number(list(files.values()))
    if not files:
        raise DataError(f"{folder} holds no image ({', '.join(suffixes)})")
    return dict(sorted(files.items()))


def paired_images(colors: dict[int, Path], depths: dict[int, Path]) -> dict[int, StoredImages]:
    """Return the images of each frame by its number. Reading a missing one raises FrameError."""
    numbers = sorted(colors.keys() | depths.keys())
    return {
        k: StoredImages.of_files(*(files.get(k) or _missing(files, k) for files in (colors, depths))) for k in numbers
    }


def _missing(files: dict[int, Path], number: int) -> Path:
    """Return the path of a missing image, named like the others."""
    first = next(iter(files.values()))
    before = _before_number(first)
    return first.with_stem(before + str(number).zfill(len(first.stem) - len(before)))


def first_size(paths: Iterable[Path], read: Callable[[Path], Array]) -> tuple[int, int]:
    """Return (width, height) in px of the first image that can be read. Raises DataError if none can."""
    errors = []
    for path in paths:
        try:
            height, width = read(path).shape[:2]
        except FrameError as error:
            errors.append(str(error))
            continue
        return width, height
    raise DataError(f"no image can be read: {errors[0]}")


def number_of(path: Path) -> int | None:
    """Return the number at the end of an image's name, or None without one."""
    digits = path.stem[len(_before_number(path)) :]
    return int(digits) if digits else None


def check_one_number(files: Sequence[Path]) -> None:
    """Raise DataError if the names of images differ in more than the number at their end."""
    for path in files:
        before, of_first = _before_number(path), _before_number(files[0])
        if before != of_first and re.search("[0-9]", before + of_first):
            raise DataError(
                f"{path.parent}: {files[0].name} and {path.name} differ in more than one number; number the frames in "
                "their order, 000000.png, 000001.png ..."
            )


def _before_number(path: Path) -> str:
    return path.stem.rstrip("0123456789")
