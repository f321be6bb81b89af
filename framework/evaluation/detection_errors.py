"""Statistics of the errors of a detector over a video with ground-truth instances.

Averages over images, such as mask AP, do not show errors that repeat in all frames of an object. Such errors do not
average out in a map. All appearances of an object are therefore evaluated together. The presets of `detector=simulated`
were fitted to these statistics.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from framework.data import Bool, Detections, FrameTruth, Int64

MIN_PIXELS = 64  # px, minimum area of an evaluated appearance
FOUND_IOU = 0.3  # minimum IoU of a found appearance, regardless of class
SIDES = (32.0, 96.0)  # px, square roots of areas: COCO's bounds between small, medium and large
MIN_APPEARANCES = 5  # minimum number of appearances of an object for its detection rate
RARE_FRACTION, FREQUENT_FRACTION = 0.25, 0.75  # bounds of the found fraction of an object's appearances
PART_INSIDE, PART_COVERS = 0.6, 0.05  # minimum shared pixels, as fractions of a detection and of an object (`parts`)
ON_ONE = 0.6  # minimum fraction of a false detection's pixels on one object of unknown class (`on_thing`)


class Appearance(NamedTuple):
    """An object of known class in one frame, with its best detection."""

    instance: int  # id of the object
    side: float  # px, square root of the area
    parts: int  # number of detections mostly on the object; see PART_INSIDE and PART_COVERS
    iou: float = 0.0  # of the object and its best detection; 0 without a detection
    inside: float = 0.0  # fraction of the detection's pixels on the object
    covered: float = 0.0  # fraction of the object's pixels in the detection
    score: float = 0.0
    class_name: str = ""
    is_right: bool = False


class FalseDetection(NamedTuple):
    """A detection that does not match an object of known class.

    It is not the best detection of any object, and at most half of its pixels are on objects of known classes.
    """

    score: float
    side: float  # px, square root of the area
    on_thing: bool  # True: more than ON_ONE of its pixels are on one object of unknown class


@dataclass
class DetectionErrors:
    """Detection errors, accumulated over frames."""

    frames: int = 0
    appearances: list[Appearance] = field(default_factory=list)
    false_detections: list[FalseDetection] = field(default_factory=list)

    def add(self, truth: FrameTruth, detections: Detections) -> None:
        """Add one frame, and compare its detections with its ground-truth instances.

        The masks have the size of the image.
        """
        self.frames += 1
        ids, shared = overlaps(truth, detections.masks)
        areas, shared = shared[0], shared[1:]
        sizes = detections.masks.sum(axis=(1, 2)).astype(np.float64)
        names = [truth.class_names.get(i) if i else None for i in ids.tolist()]
        known = np.array([name is not None for name in names], np.bool_)
        used: set[int] = set()
        for column in np.flatnonzero(known & (areas >= MIN_PIXELS)).tolist():
            on, area = shared[:, column], float(areas[column])
            iou = on / (sizes + area - on)
            parts = int(np.count_nonzero((on > PART_INSIDE * sizes) & (on > PART_COVERS * area)))
            seen = Appearance(int(ids[column]), area**0.5, parts)
            if iou.any():
                best = int(iou.argmax())
                used.add(best)
                class_name = detections.classes[int(detections.class_probabilities[best].argmax())]
                seen = seen._replace(
                    iou=float(iou[best]),
                    inside=float(on[best] / sizes[best]),
                    covered=float(on[best] / area),
                    score=float(detections.scores[best]),
                    class_name=class_name,
                    is_right=class_name == names[column],
                )
            self.appearances.append(seen)
        thing = ~known & (ids > 0)
        for k in sorted(set(range(len(detections))) - used):
            if shared[k, known].sum() <= sizes[k] / 2:
                on_thing = bool(shared[k, thing].max(initial=0) > ON_ONE * sizes[k])
                self.false_detections.append(
                    FalseDetection(float(detections.scores[k]), float(sizes[k] ** 0.5), on_thing)
                )

    def table(self) -> dict[str, float]:
        """Return all statistics by name. Statistics without data are NaN."""
        hits = [one for one in self.appearances if one.iou >= FOUND_IOU]
        scores = [one.score for one in hits]
        of_objects = _by_object(self.appearances)
        objects = [_found(seen) for seen in of_objects if len(seen) >= MIN_APPEARANCES]
        small, medium, large = (
            _found(one for one in self.appearances if low <= one.side < high)
            for low, high in ((0.0, SIDES[0]), SIDES, (SIDES[1], np.inf))
        )
        several = [[one.class_name for one in seen] for seen in _by_object(hits) if len(seen) > 1]
        most_often = sum(max(Counter(names).values()) for names in several)
        return {
            "found": _found(self.appearances),
            "found, small": small,
            "found, medium": medium,
            "found, large": large,
            "objects found in < 1/4 of the frames": _mean(fraction < RARE_FRACTION for fraction in objects),
            "objects found in > 3/4 of the frames": _mean(fraction > FREQUENT_FRACTION for fraction in objects),
            "mask IoU": _mean(one.iou for one in hits),
            "fraction of the mask on the object": _mean(one.inside for one in hits),
            "fraction of the object in the mask": _mean(one.covered for one in hits),
            "correct class": _mean(one.is_right for one in hits),
            "same class as in the other frames": most_often / sum(map(len, several)) if several else float("nan"),
            "score": _mean(scores),
            "score, standard deviation": float(np.std(scores)) if scores else float("nan"),
            "objects with several detections": _mean(one.parts > 1 for one in self.appearances),
            "false detections per image": len(self.false_detections) / max(self.frames, 1),
            "false detections on an unknown object": _mean(one.on_thing for one in self.false_detections),
            "score of false detections": _mean(one.score for one in self.false_detections),
            "side of false detections (px)": _mean(one.side for one in self.false_detections),
        }


def _by_object(appearances: Iterable[Appearance]) -> list[list[Appearance]]:
    objects: defaultdict[int, list[Appearance]] = defaultdict(list)
    for one in appearances:
        objects[one.instance].append(one)
    return list(objects.values())


def overlaps(truth: FrameTruth, masks: Bool) -> tuple[Int64, Int64]:
    """Return the ids of all instances in a frame, and their overlaps with masks (N, H, W).

    Returns:
        The ids (M,) and pixel counts (1 + N, M). Row 0 counts the pixels of the frame. Row 1 + k counts the pixels in
        mask k.
    """
    ids, index = np.unique(truth.instance_ids.ravel(), return_inverse=True)
    counts = [np.bincount(index, minlength=len(ids))]
    counts += [np.bincount(index[mask.ravel()], minlength=len(ids)) for mask in masks]
    return ids.astype(np.int64), np.stack(counts).astype(np.int64)


def _found(appearances: Iterable[Appearance]) -> float:
    return _mean(one.iou >= FOUND_IOU for one in appearances)


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return float(np.mean(listed)) if listed else float("nan")
