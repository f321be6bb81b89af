"""Image folders in which each file name ends in the frame number."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from framework.data import Array
from framework.datasets.frames.sequence_reader import StoredImages
from framework.errors import DataError, FrameError


def numbered_images(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Return the paths of the images in a folder by frame number, in ascending order.

    Each name must end in a unique number. Names must not differ in other digits, such as the decimals of a timestamp.

    Raises:
        DataError: The folder contains no images, or a name is invalid.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a folder, got none")
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        number = number_of(path)
        if number is None:
            raise DataError(
                f"{folder}: expected names that end in a frame number, such as 000000{path.suffix}, got {path.name}"
            )
        if number in files:
            found = f"got {number} for {files[number].name} and {path.name}"
            raise DataError(f"{folder}: expected unique frame numbers, {found}")
        files[number] = path
    check_one_number(list(files.values()))
    if not files:
        raise DataError(f"{folder}: expected files ({', '.join(suffixes)}), got {_other_files(folder)}")
    return dict(sorted(files.items()))


def _other_files(folder: Path) -> str:
    """Return the number of files by suffix, for messages."""
    counts = Counter(path.suffix for path in folder.iterdir() if path.suffix and not path.name.startswith("."))
    return ", ".join(f"{count} {suffix} files" for suffix, count in counts.most_common(3)) or "none"


def paired_images(colors: dict[int, Path], depths: dict[int, Path]) -> dict[int, StoredImages]:
    """Return the color and depth images by frame number.

    If a file is missing, reading the image raises FrameError.
    """
    numbers = sorted(colors.keys() | depths.keys())
    return {
        k: StoredImages.of_files(*(files.get(k) or _missing(files, k) for files in (colors, depths))) for k in numbers
    }


def _missing(files: dict[int, Path], number: int) -> Path:
    """Return the expected path of a missing image, with a name like those of the other files."""
    first = next(iter(files.values()))
    before = _before_number(first)
    return first.with_stem(before + str(number).zfill(len(first.stem) - len(before)))


def first_size(paths: Iterable[Path], read: Callable[[Path], Array]) -> tuple[int, int]:
    """Return the width and height in px of the first readable image.

    Raises:
        DataError: No image is readable.
    """
    errors = []
    for path in paths:
        try:
            height, width = read(path).shape[:2]
        except FrameError as error:
            errors.append(str(error))
            continue
        return width, height
    found = f"got none among {len(errors)} images; first error: {errors[0]}"
    raise DataError(f"{path.parent}: expected a readable image, {found}")


def number_of(path: Path) -> int | None:
    """Return the number at the end of a file name, or None without a number."""
    digits = path.stem[len(_before_number(path)) :]
    return int(digits) if digits else None


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """Return a sort key for names, by which frame 10 follows frame 9."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split("([0-9]{1,18})", name) if part]


def check_one_number(files: Sequence[Path]) -> None:
    """Raise DataError if the names of images differ in digits before the frame number."""
    for path in files:
        before, of_first = _before_number(path), _before_number(files[0])
        if before != of_first and re.search("[0-9]", before + of_first):
            raise DataError(
                f"{path.parent}: expected names that differ in one number, got {files[0].name} and {path.name}; number "
                "the frames in order: 000000.png, 000001.png ..."
            )


def _before_number(path: Path) -> str:
    return path.stem.rstrip("0123456789")
