"""COCO results files: a JSON list with an entry for each detection (cocodataset.org/#format-results).

In addition to COCO's keys, an entry may contain `category_name` and the distribution `class_probabilities`. pycocotools
is not used for reading, because it requires an annotation file and does not validate entries.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path, PurePosixPath
from typing import Any, TextIO

import numpy as np

from framework.data import MAX_PIXELS, Detections, Float32
from framework.detection.masks.run_length import check, encode, pack
from framework.detection.stored.stored_detection import (
    Polygons,
    RunLengths,
    Segmentation,
    StoredDetection,
    read_label,
    read_probabilities,
    read_score,
)
from framework.errors import ConfigError, DataError, errors_of
from framework.files.atomic_write import atomic_write
from framework.files.json_file import read_json
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID, NO_CLASS

MAX_DIGITS = 18  # maximum length of a frame number


class CategoryIds(Enum):
    """Numbering of the classes in `category_id`."""

    COCO_91 = "ids of COCO's annotation files: 1 to 90, with gaps"
    FROM_ONE = "indices of the labels, from 1"
    FROM_ZERO = "indices of the labels, from 0"

    def of(self, labels: Sequence[str]) -> list[int]:
        """Return the id of each label.

        Raises:
            ConfigError: The labels do not match this numbering.
        """
        if self is not CategoryIds.COCO_91:
            return list(range(len(labels))) if self is CategoryIds.FROM_ZERO else list(range(1, len(labels) + 1))
        if tuple(labels) != COCO:
            raise ConfigError(
                "detector.category_ids: expected FROM_ONE or FROM_ZERO unless label_space is coco, got COCO_91"
            )
        return [k for k, name in enumerate(COCO_BY_ID) if name != NO_CLASS]


def read_results(path: Path, labels: Sequence[str], ids: CategoryIds) -> list[StoredDetection]:
    """Read the detections in a results file.

    `segmentation` contains run lengths or polygons. `image_id` is a frame index, or a file name such as
    "color/000012.png".

    Args:
        path: The results file.
        labels: The class names of the file's label space.
        ids: The numbering of `category_id`, for entries without `category_name`.

    Raises:
        DataError: An entry is invalid.
    """
    entries = read_json(path)
    if not isinstance(entries, list):
        raise DataError(f"{path}: expected a list of results in COCO's format, got {entries!r:.100}")
    index = {name: k for k, name in enumerate(labels)}
    names: dict[int, str] | None = None
    found: list[StoredDetection] = []
    folders: dict[int, PurePosixPath] = {}
    for k, entry in enumerate(entries):
        where = f"{path}, entry {k}"
        if not isinstance(entry, Mapping):
            raise DataError(f"{where}: expected a JSON object, got {entry!r:.200}")
        if names is None and entry.get("category_name") is None:
            names = dict(zip(ids.of(labels), labels, strict=True))
        with errors_of(where):
            found.append(_read_entry(where, entry, index, names or {}))
            if isinstance(entry["image_id"], str):
                image, frame = PurePosixPath(entry["image_id"]), found[-1].frame
                if (other := folders.setdefault(frame, image.parent)) != image.parent:
                    raise DataError(
                        f"{image}: expected one image of frame {frame}, got another image in {other}/; "
                        "split the file by sequence"
                    )
    return found


def _read_entry(
    where: str, entry: Mapping[str, Any], index: Mapping[str, int], names: Mapping[int, str]
) -> StoredDetection:
    if entry.get("category_name") is not None:
        label = read_label(entry["category_name"], index)
    elif type(entry.get("category_id")) is int and entry["category_id"] in names:
        label = names[entry["category_id"]]
    else:
        raise DataError(
            f"category_id: expected the id of a label, got {entry.get('category_id')!r}; set "
            "detector.category_ids to the numbering of the file"
        )
    return StoredDetection(
        where=where,
        frame=_read_image_id(entry.get("image_id")),
        label=label,
        score=read_score(entry.get("score")),
        segmentation=_read_segmentation(entry.get("segmentation")),
        probabilities=read_probabilities(entry.get("class_probabilities"), index),
        box=_read_box(entry.get("bbox")),
        exact=entry.get("exact") is True,
    )


def _read_image_id(found: Any) -> int:
    if type(found) is int and found >= 0:
        return found
    name = PurePosixPath(found if isinstance(found, str) else "")
    stem = "" if name.suffix[1:].isdigit() else name.stem  # 12.5 is not a file name
    if not (stem.isascii() and stem.isdigit() and len(stem) <= MAX_DIGITS):
        raise DataError(f"image_id: expected a frame number, or a file name such as 000012.png, got {found!r}")
    return int(stem)


def _read_box(found: Any) -> Float32 | None:
    if found is None:
        return None
    whole = isinstance(found, list) and len(found) == 4
    if not whole or not all(isinstance(x, int | float) and abs(x) <= MAX_PIXELS for x in found) or min(found[2:]) < 0:
        raise DataError(
            f"bbox: expected [x, y, width, height] px, at most {MAX_PIXELS} px each, width and height >= 0, got "
            f"{found!r:.200}"
        )
    x, y, width, height = found
    return np.array([x, y, x + width, y + height], np.float32)


def _read_segmentation(found: Any) -> Segmentation:
    if isinstance(found, list):
        return _read_polygons(found)
    size = found.get("size") if isinstance(found, Mapping) else None
    if not isinstance(size, list) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise DataError(
            f"segmentation: expected run lengths with size [height, width], or a list of polygons, got {found!r:.200}"
        )
    shape = (size[0], size[1])
    if shape[0] * shape[1] > MAX_PIXELS:
        raise DataError(f"segmentation.size: expected at most {MAX_PIXELS} px, got {shape[1]}x{shape[0]} px")
    counts = found.get("counts")
    if isinstance(counts, list):
        return RunLengths(pack(counts, shape), shape)
    if not isinstance(counts, str) or not counts.isascii():
        raise DataError(f"segmentation.counts: expected a packed string or a list of run lengths, got {counts!r:.100}")
    check(counts.encode(), shape)
    return RunLengths(counts.encode(), shape)


def _read_polygons(found: Sequence[Any]) -> Polygons:
    for outline in found:
        if not isinstance(outline, list) or len(outline) < 6 or len(outline) % 2:
            raise DataError(f"polygon: expected a list x1, y1, x2, y2, ... for at least 3 points, got {outline!r:.100}")
        if not all(isinstance(x, int | float) and np.isfinite(x) for x in outline):
            raise DataError(f"polygon: expected finite coordinates in px, got {outline!r:.100}")
    if not found:
        raise DataError("segmentation: expected at least one polygon, got an empty list")
    return Polygons(tuple(tuple(float(x) for x in outline) for outline in found))


class ResultWriter:
    """Writer of a results file."""

    def __init__(self, file: TextIO, classes: tuple[str, ...]) -> None:
        self._file = file
        self._classes = classes
        self._ids = (CategoryIds.COCO_91 if classes == COCO else CategoryIds.FROM_ONE).of(classes)
        self.count = 0  # number of written entries
        self.frames = 0

    def write(self, frame: int, detections: Detections) -> None:
        """Write the detections of a frame."""
        height, width = detections.masks.shape[1:]
        best = detections.class_probabilities.argmax(axis=1).tolist()
        boxes = detections.boxes.astype(np.float64)  # float64 makes x + width exactly x2
        for k, counts in enumerate(encode(detections.masks)):
            x1, y1, x2, y2 = boxes[k].tolist()
            entry = {
                "image_id": frame,
                "category_id": self._ids[best[k]],
                "category_name": self._classes[best[k]],
                "segmentation": {"size": [height, width], "counts": counts.decode()},
                "bbox": [x1, y1, x2 - x1, y2 - y1],
                "score": _shortest(detections.scores[k : k + 1])[0],
                "class_probabilities": _shortest(detections.class_probabilities[k]),
                **({"exact": True} if detections.exact else {}),
            }
            self._file.write((",\n" if self.count else "") + json.dumps(entry, separators=(",", ":"), allow_nan=False))
            self.count += 1
        self.frames += 1


@contextmanager
def results_file(path: Path, classes: tuple[str, ...]) -> Iterator[ResultWriter]:
    """Open a results file for writing.

    The file is created atomically at the end of the block.
    """
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write("[\n")
        yield ResultWriter(file, classes)
        file.write("\n]\n")


def _shortest(values: Float32) -> list[float]:
    """Convert float32 values to floats with as few decimal digits as possible."""
    return [float(text) for text in values.astype(str)]  # halves the file size
