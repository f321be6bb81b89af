"""Folders with instance masks.

Each frame has an image of instance ids, such as 000012.png, and a file 000012.json of classes and scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from framework.data import Bool
from framework.detection.stored.image_names import ImageName
from framework.detection.stored.stored_detection import (
    Segmentation,
    StoredDetection,
    read_label,
    read_probabilities,
    read_score,
)
from framework.errors import DataError, errors_of
from framework.files.image_files import read_ids
from framework.files.json_file import read_json

_read_ids = lru_cache(maxsize=1)(read_ids)  # the detections of a frame share an image

LARGEST_ID = np.iinfo(np.uint16).max


@dataclass(frozen=True)
class InstanceOfImage(Segmentation):
    """The pixels with one instance id in an image."""

    path: Path
    id: int

    def mask(self, shape: tuple[int, int]) -> Bool:
        ids = _read_ids(self.path)
        if ids.shape != shape:
            raise DataError(
                f"image: expected the frame's size, {shape[1]}x{shape[0]} px, got {ids.shape[1]}x{ids.shape[0]} px; "
                "use masks at the resolution of the sequence"
            )
        return np.asarray(ids == self.id, np.bool_)


def read_mask_folder(folder: Path, labels: Sequence[str]) -> list[StoredDetection]:
    """Read the detections in a mask folder.

    The files of a frame have the name of its color image. The PNG has one channel of 8 or 16 bits. The JSON is a list
    of objects with the keys "id", "class", "score" and optionally "class_probabilities". Ids that are not listed are
    ignored.

    Args:
        folder: The mask folder.
        labels: The class names of the folder's label space.

    Raises:
        DataError: A file or an entry is invalid.
    """
    index = {name: k for k, name in enumerate(labels)}
    found: list[StoredDetection] = []
    images: dict[tuple[str, int], Path] = {}
    for path in sorted(folder.glob("*.png")):
        name = ImageName.of(path.name)
        if name.number is not None and (other := images.setdefault((name.prefix, name.number), path)) != path:
            raise DataError(
                f"{path}: expected one image of frame {name.number}, got {other.name} as well; keep one of them"
            )
        description = path.with_suffix(".json")
        ids: set[int] = set()
        entries = read_json(description)
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise DataError(
                f"{description}: expected a list of JSON objects with id, class and score, got {entries!r:.100}"
            )
        for k, entry in enumerate(entries):
            where = f"{description}, entry {k}"
            with errors_of(where):
                instance = _read_id(entry.get("id"))
                if instance in ids:
                    raise DataError(f"id: expected unique ids, got {instance} twice")
                ids.add(instance)
                label, score = read_label(entry.get("class"), index), read_score(entry.get("score"))
                probabilities = read_probabilities(entry.get("class_probabilities"), index)
                found.append(StoredDetection(where, name, label, score, InstanceOfImage(path, instance), probabilities))
    alone = [path for path in sorted(folder.glob("*.json")) if not path.with_suffix(".png").exists()]
    if alone:
        raise DataError(f"{alone[0]}: expected an image {alone[0].stem}.png next to it, got none")
    return found


def _read_id(found: object) -> int:
    if type(found) is not int or not 0 < found <= LARGEST_ID:
        raise DataError(f"id: expected an integer in [1, {LARGEST_ID}], got {found!r}")
    return found
