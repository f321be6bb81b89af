"""What a detector does wrong, counted over a video whose frames have true instances.

Averages over pictures, such as mask AP, do not say what a map suffers from: errors that an object has in all frames do
not average out. So an object's appearances are looked at together. These are also the figures that the presets of
`detector=simulated` were fitted to.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from framework.data import Bool, Detections, Float64, FrameTruth, Int64

SMALLEST = 64  # px, an appearance that counts
FOUND_IOU = 0.3  # of an appearance that is found, whatever it is taken for
SIDES = (32.0, 96.0)  # px, square roots of areas: COCO's bounds between small, medium and large
ENOUGH = 5  # appearances of an object whose share of found ones means something
RARELY, MOSTLY = 0.25, 0.75  # shares of an object's appearances
PART_INSIDE, PART_COVERS = 0.6, 0.05  # of the detection, of the object: from here on a detection is a part of an object
ON_ONE = 0.6  # of a false detection on one thing: from here on it is the thing that is taken for an object


@dataclass(frozen=True)
class Appearance:
    """One object of a known class in one frame."""

    instance: int
    side: float  # px, square root of the area
    parts: int  # detections that lie mostly on it
    iou: float  # of the best detection
    inside: float  # share of that detection on the object
    covered: float  # share of the object under that detection
    score: float
    said: str  # its class
    is_right: bool

    @property
    def found(self) -> bool:
        return self.iou >= FOUND_IOU


@dataclass(frozen=True)
class FalseDetection:
    """A detection that lies mostly on no object of a known class."""

    score: float
    side: float  # px
    on_thing: bool  # mostly on one thing of unknown class


@dataclass
class DetectionFaults:
    """Counts frame by frame; the properties are means over all of them, NaN where there is nothing to count."""

    frames: int = 0
    appearances: list[Appearance] = field(default_factory=list)
    false_detections: list[FalseDetection] = field(default_factory=list)

    def add(self, truth: FrameTruth, detections: Detections) -> None:
        """Compares one frame's detections (masks of the image's size) with its true instances."""
        self.frames += 1
        ids, shared = overlaps(truth, detections.masks)
        areas, sizes = shared[0], detections.masks.sum(axis=(1, 2)).astype(np.float64)
        shared = shared[1:]
        names = [truth.class_names.get(i) if i else None for i in ids.tolist()]
        best_classes = detections.class_probabilities.argmax(axis=1) if len(detections) else np.empty(0, np.int64)
        said = [detections.classes[k] for k in best_classes.tolist()]
        used: set[int] = set()
        for column, (instance, name) in enumerate(zip(ids.tolist(), names, strict=True)):
            if name is None or areas[column] < SMALLEST:
                continue
            on, area = shared[:, column], float(areas[column])
            iou = on / (sizes + area - on)
            parts = int(np.count_nonzero((on > PART_INSIDE * sizes) & (on > PART_COVERS * area)))
            best = int(iou.argmax()) if len(iou) else -1
            if best < 0 or iou[best] == 0:
                self.appearances.append(Appearance(instance, area**0.5, parts, 0.0, 0.0, 0.0, 0.0, "", False))
                continue
            used.add(best)
            self.appearances.append(
                Appearance(
                    instance,
                    area**0.5,
                    parts,
                    float(iou[best]),
                    float(on[best] / sizes[best]),
                    float(on[best] / area),
                    float(detections.scores[best]),
                    said[best],
                    said[best] == name,
                )
            )
        known = np.array([name is not None for name in names], np.bool_)
        thing = ~known & (ids > 0)
        for k in range(len(detections)):
            if shared[k, known].sum() <= sizes[k] / 2 and k not in used:
                on_thing = bool(shared[k, thing].max(initial=0) > ON_ONE * sizes[k])
                self.false_detections.append(
                    FalseDetection(float(detections.scores[k]), float(sizes[k] ** 0.5), on_thing)
                )

    def found(self, smallest: float = 0.0, largest: float = np.inf) -> float:
        """Share of the appearances with a side in [smallest, largest) px that are found."""
        return _mean(one.found for one in self.appearances if smallest <= one.side < largest)

    def objects_found(self) -> Float64:
        """Of each object with ENOUGH appearances the share that is found."""
        return np.array([_mean(o.found for o in of) for of in self._by_object(self.appearances) if len(of) >= ENOUGH])

    def same_class(self) -> float:
        """Of an object's found appearances the share that is taken for the class that it is most often taken for."""
        most = [
            (max(Counter(one.said for one in of).values()), len(of))
            for of in self._by_object(self._hits)
            if len(of) > 1
        ]
        return sum(n for n, _ in most) / sum(n for _, n in most) if most else float("nan")

    def table(self) -> dict[str, float]:
        """All figures by what they are, in the order of the presets' cards."""
        hits, objects, scores = self._hits, self.objects_found(), [one.score for one in self._hits]
        return {
            "found": self.found(),
            "found, small": self.found(largest=SIDES[0]),
            "found, medium": self.found(*SIDES),
            "found, large": self.found(smallest=SIDES[1]),
            "objects found in < 1/4 of the frames": _mean((objects < RARELY).tolist()),
            "objects found in > 3/4 of the frames": _mean((objects > MOSTLY).tolist()),
            "mask IoU": _mean(one.iou for one in hits),
            "share of the mask on the object": _mean(one.inside for one in hits),
            "share of the object in the mask": _mean(one.covered for one in hits),
            "class right": _mean(one.is_right for one in hits),
            "class as in the object's other frames": self.same_class(),
            "score": _mean(scores),
            "score, standard deviation": float(np.std(scores)) if scores else float("nan"),
            "objects in several parts": _mean(one.parts > 1 for one in self.appearances),
            "false detections an image": len(self.false_detections) / max(self.frames, 1),
            "false detections on one thing": _mean(one.on_thing for one in self.false_detections),
            "score of false detections": _mean(one.score for one in self.false_detections),
            "side of false detections (px)": _mean(one.side for one in self.false_detections),
        }

    @property
    def _hits(self) -> list[Appearance]:
        return [one for one in self.appearances if one.found]

    @staticmethod
    def _by_object(appearances: Iterable[Appearance]) -> Iterator[list[Appearance]]:
        objects: defaultdict[int, list[Appearance]] = defaultdict(list)
        for one in appearances:
            objects[one.instance].append(one)
        yield from objects.values()


def overlaps(truth: FrameTruth, masks: Bool) -> tuple[Int64, Int64]:
    """The ids (M,) in a frame, and how many pixels of each (1 + N, M) there are: in all, and in each mask (N, H, W)."""
    ids, index = np.unique(truth.instance_ids.ravel(), return_inverse=True)
    counts = [np.bincount(index, minlength=len(ids))]
    counts += [np.bincount(index[mask.ravel()], minlength=len(ids)) for mask in masks]
    return ids.astype(np.int64), np.stack(counts).astype(np.int64)


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return float(np.mean(listed)) if listed else float("nan")
