"""Detections that somebody wrote to a disk: read strictly, whatever program wrote them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import PROBABILITY_TOLERANCE, Bool, Float32
from framework.detection.masks.run_length import decode
from framework.errors import DataError

ROUNDED_SUM = 0.05  # |sum - 1| of a row of probabilities that counts as rounded when it was printed
LARGEST = 1e6  # probability that is read before the sum is looked at


class Segmentation(ABC):
    """Where an object is in its image."""

    @abstractmethod
    def mask(self, shape: tuple[int, int]) -> Bool:
        """The mask (H, W) for an image of `shape` (height, width). Raises DataError when it is of another size."""


@dataclass(frozen=True)
class RunLengths(Segmentation):
    """COCO's run lengths, packed; checked when they were read."""

    counts: bytes
    shape: tuple[int, int]  # height, width

    def mask(self, shape: tuple[int, int]) -> Bool:
        if self.shape != shape:
            raise DataError(
                f"the mask is {self.shape[1]}x{self.shape[0]} px, but the frame {shape[1]}x{shape[0]} px:"
                " it must be of the sequence's own resolution"
            )
        return np.asarray(decode([self.counts], shape)[0], np.bool_)


@dataclass(frozen=True)
class Polygons(Segmentation):
    """The outlines of an object's parts, each x1 y1 x2 y2 ... px; as COCO has it, the image begins at (0, 0)."""

    outlines: tuple[tuple[float, ...], ...]

    def mask(self, shape: tuple[int, int]) -> Bool:
        from pycocotools import mask as coco

        height, width = shape
        outside = max(
            max(max(outline[::2]) - width, max(outline[1::2]) - height, -min(outline)) for outline in self.outlines
        )
        if outside > 1:  # px; annotation tools let outlines reach a little over the border
            raise DataError(f"a polygon reaches {outside:g} px out of the image of {width}x{height} px")
        runs = coco.merge(coco.frPyObjects([list(outline) for outline in self.outlines], height, width))
        return np.asarray(decode([runs["counts"]], shape)[0], np.bool_)


@dataclass(frozen=True)
class StoredDetection:
    """One object of one image, as it was written."""

    where: str  # the place in the file, for errors
    frame: int  # Frame.index
    label: str  # of the file's label space
    score: float  # in [0, 1]
    segmentation: Segmentation
    probabilities: Float32 | None = None  # (C,) a distribution over the file's label space; None = only the label
    box: Float32 | None = None  # (4,) x1 y1 x2 y2 px; None = the mask's tight one
    exact: bool = False  # as in Detections


def read_score(found: Any) -> float:
    """A score in [0, 1]. Raises DataError for anything else."""
    if isinstance(found, bool) or not isinstance(found, int | float) or not 0 <= found <= 1:
        raise DataError(f"score must be a number in [0, 1], found {found!r}")
    return float(found)


def read_label(found: Any, index: Mapping[str, int]) -> str:
    """A name of the label space. Raises DataError for anything else."""
    if not isinstance(found, str) or found not in index:
        raise DataError(f"{found!r} is not one of the {len(index)} labels: set detector.labels to the file's own")
    return found


def read_probabilities(found: Any, index: Mapping[str, int]) -> Float32 | None:
    """A distribution (C,) over the label space: a list in its order, or a mapping from names (others have 0).

    Rows that were rounded when they were printed are normalised; others come back to the bit. None = not given. Raises
    DataError for what is not a distribution.
    """
    if found is None:
        return None
    if isinstance(found, Mapping):
        unknown = [name for name in found if name not in index]
        if unknown:
            raise DataError(f"class_probabilities: not among the {len(index)} labels: {', '.join(map(repr, unknown))}")
        given: Sequence[Any] = [found.get(name, 0.0) for name in index]
    elif isinstance(found, list):
        given = found
    else:
        raise DataError(f"class_probabilities must be a list or an object, found {found!r}")
    if len(given) != len(index):
        raise DataError(f"class_probabilities must have {len(index)} values, one for each label, found {len(given)}")
    if not all(isinstance(p, int | float) and 0 <= p <= LARGEST for p in given):  # NaN is none
        raise DataError("class_probabilities must be numbers, 0 or more and about 1 together")
    row = np.array(given, np.float32)
    total = float(row.sum(dtype=np.float64))
    if abs(total - 1) > ROUNDED_SUM:
        raise DataError(f"class_probabilities must sum to 1, found {total:g}")
    return row if abs(total - 1) <= PROBABILITY_TOLERANCE else np.asarray(row / np.float32(total), np.float32)
