"""Image ids of stored detections: whole numbers and file names."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import PureWindowsPath

from framework.errors import DataError

MAX_DIGITS = 20  # maximum length of a frame number; times in ns have 19 digits
EARLIEST_TIME = 1e8  # s since 1970, minimum timestamp
DIGITS = "0123456789"
# end of a name before the suffix: that of Roboflow's exports, or the suffix of the color image, as in 000012.jpg.png
EXPORTED = re.compile(r"(_(jpe?g|png)\.rf\.\w+|\.(jpe?g|png))$", re.IGNORECASE)
NUMBERED = re.compile(r"\D*|.*[a-zA-Z].*[_-]")  # start of a name with a number, such as cam0_; not of a timestamp
COLOR_ENDING = ".color"  # end of the names of color images in 7-Scenes and ScanNet, before the suffix


@dataclass(frozen=True)
class ImageName:
    """A file name without folders and suffix, such as frame_000012."""

    stem: str
    prefix: str  # `stem` before its number
    number: int | None  # the number at the end of `stem`, unless it is part of a timestamp; None = no such number

    @classmethod
    def of(cls, path: str) -> ImageName:
        """Parse a path with slashes or backslashes. The suffix is optional."""
        name = PureWindowsPath(path)  # accepts both separators
        stem = name.name if name.suffix[1:].isdigit() else name.stem  # the suffix of 1305031102.175304 is no file type
        stem = EXPORTED.sub("", stem).removesuffix(COLOR_ENDING)
        prefix = stem.rstrip(DIGITS)
        digits = stem[len(prefix) :]
        has_number = 0 < len(digits) <= MAX_DIGITS and NUMBERED.fullmatch(prefix) is not None
        return cls(stem, prefix, int(digits) if has_number else None)

    def names(self, other: ImageName) -> bool:
        """Return True if both are names of the same image.

        Numbers may be padded with zeros, and one of the names may consist of the number only.
        """
        if self.stem == other.stem:
            return True
        same_prefix = self.prefix == other.prefix or not (self.prefix and other.prefix)
        return self.number is not None and self.number == other.number and same_prefix


ImageId = int | ImageName
"""Image id of stored detections: a whole number or a file name."""


def read_image_id(found: object) -> ImageId:
    """Return the image id in a file.

    Raises:
        DataError: The value is neither a whole number nor a file name.
    """
    if isinstance(found, float) and found.is_integer():
        found = int(found)
    if isinstance(found, float) and EARLIEST_TIME < found < math.inf:
        found = f"{found:.6f}"  # as in TUM's file names
    if type(found) is int and 0 <= found < 10**MAX_DIGITS:
        return found
    name = ImageName.of(found) if isinstance(found, str) else None
    if name is None or not name.stem.strip():
        raise DataError(f"image_id: expected a frame number, or a file name such as 000012.png, got {found!r}")
    return name


def shown(image: ImageId) -> str:
    """Format an image id for messages."""
    return str(image) if isinstance(image, int) else repr(image.stem)
