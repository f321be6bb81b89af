"""Detections that were stored by other programs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pycocotools import mask as coco

from framework.data import PROBABILITY_TOLERANCE, Bool, Float32
from framework.detection.masks.run_length import decode
from framework.detection.stored.image_names import ImageId
from framework.errors import DataError
from framework.vocabulary.label_spaces import coco_name

ROUNDED_SUM = 0.05  # largest |sum - 1| of probabilities with rounded digits
MAX_PROBABILITY = 1e6  # maximum of a single value, checked before the sum to prevent overflow


class Segmentation(ABC):
    """The region of an object in an image."""

    @abstractmethod
    def mask(self, shape: tuple[int, int]) -> Bool:
        """Return the mask (H, W) for an image of size `shape` (height, width).

        Raises:
            DataError: The segmentation is from an image of another size.
        """


@dataclass(frozen=True)
class RunLengths(Segmentation):
    """Packed run lengths in COCO's format, already validated."""

    counts: bytes
    shape: tuple[int, int]  # height, width

    def mask(self, shape: tuple[int, int]) -> Bool:
        if self.shape != shape:
            raise DataError(
                f"mask: expected the frame's size, {shape[1]}x{shape[0]} px, got {self.shape[1]}x{self.shape[0]} "
                "px; use masks at the resolution of the sequence"
            )
        return np.asarray(decode([self.counts], shape)[0], np.bool_)


@dataclass(frozen=True)
class Polygons(Segmentation):
    """Outlines x1 y1 x2 y2 ... of the parts of an object, px.

    The image corner is at (0, 0), as in COCO.
    """

    outlines: tuple[tuple[float, ...], ...]

    def mask(self, shape: tuple[int, int]) -> Bool:
        height, width = shape
        outside = max(
            max(max(outline[::2]) - width, max(outline[1::2]) - height, -min(outline)) for outline in self.outlines
        )
        if outside > 1:  # px; outlines from annotation tools slightly exceed the image
            raise DataError(
                f"polygon: expected points in the image of {width}x{height} px, got a point {outside:g} px outside"
            )
        runs = coco.merge(coco.frPyObjects([list(outline) for outline in self.outlines], height, width))
        return np.asarray(decode([runs["counts"]], shape)[0], np.bool_)


@dataclass(frozen=True)
class StoredDetection:
    """One detection in a file."""

    where: str  # file and entry, for errors
    image: ImageId  # whole number or file name of the image
    label: str  # name in the file's label space
    score: float  # in [0, 1]
    segmentation: Segmentation
    probabilities: Float32 | None = None  # (C,) distribution over the file's label space; None = label only
    box: Float32 | None = None  # (4,) x1 y1 x2 y2 px; None = tight box of the mask
    exact: bool = False  # True = ground-truth mask, which refiners do not change


def read_score(found: Any) -> float:
    """Return a score.

    Raises:
        DataError: The value is not a number in [0, 1].
    """
    if isinstance(found, bool) or not isinstance(found, int | float) or not 0 <= found <= 1:
        raise DataError(f"score: expected a number in [0, 1], got {found!r}")
    return float(found)


def read_label(found: Any, index: Mapping[str, int]) -> str:
    """Return a class name. Other known names of a class, such as "sofa" for "couch", are converted.

    Raises:
        DataError: The value is not a name in `index`.
    """
    if not isinstance(found, str):
        raise DataError(f"label: expected a class name, got {found!r}; write the name of the class")
    if found not in index:
        found = coco_name(found) or coco_name(found.replace("_", " ")) or found
    if found not in index:
        raise DataError(
            f"label: expected one of the {len(index)} names in detector.label_space, got {found!r}; set "
            "detector.label_space to the label space of the file"
        )
    return str(found)


def read_probabilities(found: Any, index: Mapping[str, int]) -> Float32 | None:
    """Return the class distribution (C,) from a JSON list or object, or None if not given.

    A JSON object has class names as keys, and missing names have the probability 0. The sum is normalized if it differs
    from 1 only by rounding.

    Args:
        found: The JSON value.
        index: The index of each class name.

    Raises:
        DataError: The value is not a distribution over these classes.
    """
    if found is None:
        return None
    count = max(index.values()) + 1  # not len(index), because several labels may be unused
    if isinstance(found, Mapping):
        unknown = [name for name in found if name not in index]
        if unknown:
            raise DataError(
                f"class_probabilities: expected only the {len(index)} names in detector.label_space, got "
                f"{', '.join(map(repr, unknown))}; set detector.label_space to the label space of the file"
            )
        by_index = {index[name]: value for name, value in found.items()}
        given: Sequence[Any] = [by_index.get(k, 0.0) for k in range(count)]
    elif isinstance(found, list):
        given = found
    else:
        raise DataError(f"class_probabilities: expected a JSON list or a JSON object, got {found!r:.200}")
    if len(given) != count:
        raise DataError(f"class_probabilities: expected {count} values, one for each label, got {len(given)}")
    if not all(isinstance(p, int | float) and 0 <= p <= MAX_PROBABILITY for p in given):  # rejects NaN
        raise DataError(f"class_probabilities: expected numbers of at least 0 with a sum of 1, got {given!r:.200}")
    row = np.array(given, np.float32)
    total = float(row.sum(dtype=np.float64))
    if abs(total - 1) > ROUNDED_SUM:
        raise DataError(f"class_probabilities: expected a sum of 1, got {total:g}")
    return row if abs(total - 1) <= PROBABILITY_TOLERANCE else np.asarray(row / np.float32(total), np.float32)
