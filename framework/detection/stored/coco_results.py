"""COCO results files: a JSON list with an entry for each detection (cocodataset.org/#format-results).

In addition to COCO's keys, an entry may contain `category_name`, `file_name` and the distribution
`class_probabilities`. Annotation files with images, annotations and categories (cocodataset.org/#format-data) are also
read. pycocotools is not used for reading, because it requires an annotation file for results and does not validate
entries.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
from typing import Any, TextIO

import numpy as np

from framework.data import MAX_PIXELS, Detections, Float32
from framework.detection.masks.run_length import check, encode, pack
from framework.detection.stored.image_names import ImageName, read_image_id
from framework.detection.stored.stored_detection import (
    Polygons,
    RunLengths,
    Segmentation,
    StoredDetection,
    read_label,
    read_probabilities,
    read_score,
)
from framework.errors import DataError, errors_of
from framework.files.atomic_write import atomic_write
from framework.files.json_file import read_json
from framework.vocabulary.category_ids import CategoryIds, recognize
from framework.vocabulary.label_spaces import COCO, whole_number


def read_results(path: Path, labels: Sequence[str], ids: CategoryIds) -> list[StoredDetection]:
    """Read the detections in a results file.

    `segmentation` contains run lengths or polygons. The image is `file_name`, such as "color/000012.png", or
    `image_id`, a whole number or file name.

    Args:
        path: The results file.
        labels: The class names of the file's label space.
        ids: The numbering of `category_id`, for entries without `category_name`.

    Raises:
        DataError: An entry is invalid.
    """
    entries = read_json(path)
    if isinstance(entries, dict):
        entries = _annotated(path, entries)
    if not isinstance(entries, list):
        raise DataError(f"{path}: expected a list of results in COCO's format, got {entries!r:.100}")
    index = {name: k for k, name in enumerate(labels)}
    names = _names_by_id(path, entries, labels, ids)
    found: list[StoredDetection] = []
    folders: dict[str, PureWindowsPath] = {}
    for k, entry in enumerate(entries):
        where = f"{path}, entry {k}"
        if not isinstance(entry, Mapping):
            raise DataError(f"{where}: expected a JSON object, got {entry!r:.200}")
        with errors_of(where):
            found.append(_read_entry(where, entry, index, names))
            if isinstance(image := found[-1].image, ImageName):
                path_of_image = PureWindowsPath(str(_image_of(entry)))
                if (other := folders.setdefault(image.stem, path_of_image.parent)) != path_of_image.parent:
                    raise DataError(
                        f"{path_of_image.as_posix()}: expected one image {image.stem}, got another image in "
                        f"{other.as_posix()}/; split the file by sequence"
                    )
    return found


def _annotated(path: Path, dataset: Mapping[str, Any]) -> list[Any]:
    """Return the annotations of a COCO dataset as results, with the names of images and categories.

    Annotations without a score have the score 1.
    """
    parts: list[Any] = [dataset.get(key) for key in ("images", "annotations", "categories")]
    if not all(isinstance(part, list) and all(isinstance(one, dict) for one in part) for part in parts):
        raise DataError(
            f"{path}: expected a list of results in COCO's format, or an object with lists of images, annotations and "
            f"categories, got the keys {', '.join(map(repr, dataset))}"
        )
    images, annotations, categories = parts
    for kind, entries in (("image", images), ("category", categories)):
        for k, one in enumerate(entries):
            if not isinstance(one.get("id"), Hashable):
                raise DataError(f"{path}, {kind} {k}: expected a numeric or string id, got {one['id']!r}")
    files = {image.get("id"): _file_of(image) for image in images}
    names = {category.get("id"): category.get("name") for category in categories}
    found = []
    for k, one in enumerate(annotations):
        ids = one.get("image_id"), one.get("category_id")
        if not all(isinstance(key, Hashable) for key in ids) or ids[0] not in files or ids[1] not in names:
            raise DataError(
                f"{path}, annotation {k}: expected ids of images and categories, got image_id="
                f"{one.get('image_id')!r}, category_id={one.get('category_id')!r}"
            )
        image, name = files[one["image_id"]], names[one["category_id"]]
        found.append({"score": 1.0, **one, "file_name": image, "category_name": name})
    return found


def _file_of(image: Mapping[str, Any]) -> Any:
    """Return the file name of an image. Roboflow keeps the name before its export in `extra`."""
    extra = image.get("extra")
    return extra["name"] if isinstance(extra, dict) and "name" in extra else image.get("file_name")


def _image_of(entry: Mapping[str, Any]) -> Any:
    return entry.get("image_id") if entry.get("file_name") is None else entry["file_name"]


def _category_of(entry: Mapping[str, Any]) -> int | None:
    """Return the `category_id` of an entry, which may also be text or 62.0; None = no whole number."""
    found = entry.get("category_id")
    return int(found) if isinstance(found, float) and found.is_integer() else whole_number(found)


def _names_by_id(path: Path, entries: Sequence[Any], labels: Sequence[str], ids: CategoryIds) -> dict[int, str]:
    """Return the label of each `category_id`, or an empty dictionary if all entries have a `category_name`."""
    objects = [entry for entry in entries if isinstance(entry, Mapping)]
    unnamed = [_category_of(entry) for entry in objects if entry.get("category_name") is None]
    numbers = [k for k in unnamed if k is not None]
    if not numbers:
        return {}
    if ids is CategoryIds.AUTO:
        pairs = [(_category_of(entry), entry.get("category_name")) for entry in objects]
        known = [(k, name) for k, name in pairs if k is not None and isinstance(name, str)]
        ids = recognize(str(path), numbers, labels, known)
    return ids.names(labels)


def _read_entry(
    where: str, entry: Mapping[str, Any], index: Mapping[str, int], names: Mapping[int, str]
) -> StoredDetection:
    category = _category_of(entry)
    if entry.get("category_name") is not None:
        label = read_label(entry["category_name"], index)
    elif entry.get("category_id") is None:
        raise DataError("category_id: expected category_id or category_name, got neither; add one of them")
    elif category is not None and category in names:
        label = names[category]
    else:
        raise DataError(
            f"category_id: expected the id of a label, got {entry.get('category_id')!r}; set "
            "detector.category_ids to the numbering of the file"
        )
    return StoredDetection(
        where=where,
        image=read_image_id(_image_of(entry)),
        label=label,
        score=read_score(entry.get("score")),
        segmentation=_read_segmentation(entry.get("segmentation")),
        probabilities=read_probabilities(entry.get("class_probabilities"), index),
        box=_read_box(entry.get("bbox")),
        exact=entry.get("exact") is True,
    )


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
            f"segmentation: expected run lengths with size [height, width], or a list of polygons, got {found!r:.200}; "
            "write masks as well as boxes"
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
