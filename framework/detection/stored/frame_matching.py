"""Matching of stored detections to the frames of a sequence."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path

from framework.detection.stored.image_names import ImageId, ImageName, shown
from framework.errors import DataError

KEY = "detector.image_ids"

log = logging.getLogger(__name__)


class ImageIds(Enum):
    """Meaning of whole numbers as image ids."""

    AUTO = "frame indices from 0; a number in a file name is that of the color image"
    FROM_ZERO = "frame indices from 0, also in file names"
    FROM_ONE = "frame indices from 1, also in file names"
    FILE_NUMBER = "numbers in the names of the color images"


class ImageIndex:
    """Image ids of stored detections, by frame."""

    def __init__(self, images: Iterable[ImageId], ids: ImageIds, path: Path) -> None:
        self.ids = ids
        self.path = path  # for messages
        self._by_stem: dict[str, ImageName] = {}
        self._by_number: dict[int, list[ImageId]] = {}
        for image in dict.fromkeys(images):
            if isinstance(image, ImageName):
                self._by_stem[image.stem] = image
            if (number := image if isinstance(image, int) else image.number) is not None:
                self._by_number.setdefault(number, []).append(image)

    def of_frame(self, index: int, name: ImageName | None) -> tuple[ImageId, ...]:
        """Return the image ids of a frame: none, one, or a number and names with this number.

        Args:
            index: The index of the frame.
            name: The name of its color image; None = no file.

        Raises:
            DataError: Images of several sequences belong to the frame.
        """
        found = self._candidates(index, name)
        prefixes = {one.prefix for one in found if isinstance(one, ImageName)}
        if len(prefixes) > 1:
            raise DataError(
                f"{self.path}: expected one image of frame {index}, got {' and '.join(map(shown, found))}; "
                "split the file by sequence"
            )
        return tuple(found)

    def _candidates(self, index: int, name: ImageName | None) -> list[ImageId]:
        file_number = None if name is None else name.number
        if self.ids is ImageIds.FILE_NUMBER:
            return [] if file_number is None else self._by_number.get(file_number, [])
        if self.ids is not ImageIds.AUTO:
            return self._by_number.get(index + (self.ids is ImageIds.FROM_ONE), [])
        indices: list[ImageId] = [one for one in self._by_number.get(index, []) if isinstance(one, int)]
        if name is not None and name.stem in self._by_stem:
            return [*indices, self._by_stem[name.stem]]
        if name is None or file_number is None:  # without a file number, a number in a name is a frame index
            return indices + [one for one in self._by_number.get(index, []) if isinstance(one, ImageName)]
        same = self._by_number.get(file_number, [])
        return indices + [one for one in same if isinstance(one, ImageName) and one.names(name)]

    def matched(self, frames: Mapping[int, str]) -> dict[int, tuple[ImageId, ...]]:
        """Return the image ids of each frame with detections, by frame index.

        Args:
            frames: The file name of each color image by frame index; "" = no file.
        """
        found = {k: self.of_frame(k, ImageName.of(name) if name else None) for k, name in frames.items()}
        return {k: images for k, images in found.items() if images}


def check_matches(path: Path, images: Sequence[ImageId], ids: ImageIds, frames: Mapping[int, str], warns: bool) -> None:
    """Check that image ids belong to the frames of a sequence, and log how they were read.

    Args:
        path: The file with the detections, for messages.
        images: The distinct image ids.
        ids: The meaning of whole numbers.
        frames: The file name of each color image by frame index, of all frames of the sequence; "" = no file.
        warns: True = log a warning if the ids may also have another meaning.

    Raises:
        DataError: No id belongs to a frame, or only another meaning of whole numbers fits all of them.
    """
    matched = ImageIndex(images, ids, path).matched(frames)
    frame_of = _frame_of(path, matched, frames)
    unmatched = [image for image in images if image not in frame_of]
    others = [one for one in ImageIds if one is not ids and _complete(path, images, one, frames) not in ({}, matched)]
    first = next(iter(frames.values())) or "frame 0"
    if unmatched and others and ids is ImageIds.AUTO:
        are_indices = matched and all(isinstance(image, int) for image in images)
        confirmed = [*others, *([ImageIds.FROM_ZERO] if are_indices else [])]
        raise DataError(
            f"{KEY}: expected ids of the {len(frames)} frames (first image: {first}), got {len(unmatched)} of "
            f"{len(images)} ids without a frame (first: {shown(unmatched[0])}) in {path}; set {_settings(confirmed)}"
        )
    if not matched:
        raise DataError(
            f"detector.path: expected detections of this sequence ({len(frames)} frames, first image: {first}), got "
            f"{path} with detections of {len(images)} other images (first: {shown(images[0])}); check that the file "
            "belongs to this sequence"
        )
    if unmatched:
        log.warning(
            "%s: expected detections of this sequence only (%d frames, first image: %s), got %d of %d images that "
            "match no frame (first: %s); check that the file belongs to this sequence",
            path, len(frames), first, len(unmatched), len(images), shown(unmatched[0]),
        )  # fmt: skip
    index, (image, *_) = next(iter(matched.items()))
    log.info("%s: detections of %d of %d frames; %s is frame %d%s", path, len(matched), len(frames), shown(image),
             index, f" ({frames[index]})" if frames[index] else "")  # fmt: skip
    if warns and ids is ImageIds.AUTO and not unmatched:
        _warn_of_other_meanings(path, frame_of, others, frames)


def _frame_of(path: Path, matched: Mapping[int, Sequence[ImageId]], frames: Mapping[int, str]) -> dict[ImageId, int]:
    """Return the frame of each image id. Raise DataError if an id belongs to several frames."""
    frame_of: dict[ImageId, int] = {}
    for k, found in matched.items():
        for image in found:
            if (other := frame_of.setdefault(image, k)) != k:
                raise DataError(
                    f"{path}: expected one frame with the image {shown(image)}, got frames {other} and {k} "
                    f"({frames[k]}); use frame indices as image ids"
                )
    return frame_of


def _warn_of_other_meanings(
    path: Path, frame_of: Mapping[ImageId, int], others: Sequence[ImageIds], frames: Mapping[int, str]
) -> None:
    """Log a warning if ids were read as frame indices, but begin at 1 or are also numbers in file names."""
    by_index = [k for one, k in frame_of.items() if isinstance(one, int) or not _is_named(one, frames[k])]
    likely = [one for one in others if one is not ImageIds.FROM_ONE or min(by_index, default=0) == 1]
    if not by_index or not likely:
        return
    reason = "begin at 1" if ImageIds.FROM_ONE in likely else "are also numbers in file names"
    log.warning(
        "%s: image ids read as frame indices from 0, but they %s; set %s if they have this meaning, or %s to confirm",
        path, reason, _settings(likely), _settings([ImageIds.FROM_ZERO]),
    )  # fmt: skip


def _settings(choices: Sequence[ImageIds]) -> str:
    return " or ".join(f"{KEY}={one.name}" for one in dict.fromkeys(choices))


def _complete(
    path: Path, images: Sequence[ImageId], ids: ImageIds, frames: Mapping[int, str]
) -> dict[int, tuple[ImageId, ...]]:
    """Return the image ids by frame, or an empty dictionary unless all ids have a frame."""
    try:
        matched = ImageIndex(images, ids, path).matched(frames)
    except DataError:
        return {}
    return matched if {one for found in matched.values() for one in found} == set(images) else {}


def _is_named(image: ImageName, file_name: str) -> bool:
    """Return True if an image id is the name or number of a file, False if it is the index of a frame."""
    name = ImageName.of(file_name)
    return image.stem == name.stem or (bool(file_name) and name.number is not None)
