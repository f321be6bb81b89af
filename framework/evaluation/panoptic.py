"""Panoptic quality of a map over things and stuff (Kirillov et al., CVPR 2019), on the points of the ground truth.

Things are the instances of the map, and stuff is its floor, walls and ceiling. Each class of stuff is one segment. A
predicted and a true segment of one class match if their IoU is above 0.5. Points of ground-truth instances that are not
evaluated, of true segments with less than MIN_POINTS points, and points without annotation, are void: they count for no
segment. A predicted segment without a match is ignored if most of its points are void, or if its class was not
annotated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from framework.data import Int32, SceneTruth, Structure, UInt8
from framework.evaluation.instances import MAX_DISTANCE, MIN_POINTS, PredictedInstances, contingency, transfer_labels

STUFF = (Structure.FLOOR, Structure.WALL, Structure.CEILING)
MATCH = 0.5  # a match has an IoU above this value, so that each segment has at most one
VOID = 0.5  # maximum fraction of void points of a false positive


@dataclass
class ClassQuality:
    """The matches of a class."""

    iou: float = 0.0  # sum of the IoUs of the true positives
    true_positives: int = 0
    false_positives: int = 0
    false_negatives: int = 0

    @property
    def pq(self) -> float:
        """Panoptic quality, eq. (1) of the paper."""
        return self.iou / (self.true_positives + 0.5 * self.false_positives + 0.5 * self.false_negatives)


@dataclass(frozen=True)
class PanopticEvaluation:
    """The result of `evaluate_panoptic`, for classes with a true or a predicted segment."""

    things: Mapping[str, ClassQuality]
    stuff: Mapping[str, ClassQuality]
    building_in_instances: float = 0.0  # fraction of the true points of floor and walls with a predicted instance

    def metrics(self) -> dict[str, float]:
        """Return the metrics by their names in metrics.json; empty without things or without stuff.

        - `panoptic.pq`, `pq_things` and `pq_stuff`: mean over all classes, the classes of things, and of stuff.
        - `panoptic.pq.<class>`: panoptic quality of a class of stuff.
        - `panoptic.building_in_instances`: fraction of the true points of floor and walls with a predicted instance.
        """
        things, stuff = ([found.pq for found in classes.values()] for classes in (self.things, self.stuff))
        if not things or not stuff:
            return {}
        return {
            "panoptic.pq": float(np.mean(things + stuff)),
            "panoptic.pq_things": float(np.mean(things)),
            "panoptic.pq_stuff": float(np.mean(stuff)),
            **{f"panoptic.pq.{name}": found.pq for name, found in self.stuff.items()},
            "panoptic.building_in_instances": self.building_in_instances,
        }


def evaluate_panoptic(predictions: PredictedInstances, truth: SceneTruth) -> PanopticEvaluation:
    """Evaluate the things and the stuff of a map by the rules in the docstring of this module.

    The result is empty if the ground truth or the map has no structure.

    Args:
        predictions: The instances of the map, with structure.
        truth: The ground truth, with structure.
    """
    if truth.structure is None or predictions.structure is None:
        return PanopticEvaluation({}, {})
    true_ids, sizes = np.unique(truth.instance_ids, return_counts=True)
    names = truth.class_names
    true_classes = {
        k: name
        for k, size in zip(true_ids.tolist(), sizes.tolist(), strict=True)
        if k > 0 and size >= MIN_POINTS and (name := names.get(k)) is not None
    }
    all_predicted = {k: name for k, name in zip(predictions.ids.tolist(), predictions.class_names, strict=True) if name}
    known = {k: name for k, name in all_predicted.items() if truth.classes is None or name in truth.classes}
    predicted = transfer_labels(
        predictions.points_world,
        _segments(predictions.instance_ids, predictions.structure),
        truth.points_world,
        MAX_DISTANCE,
    )
    true = _segments(truth.instance_ids, truth.structure)
    small = [-kind for kind in STUFF if (true == -kind).sum() < MIN_POINTS]
    return _matched(predicted, np.where(np.isin(true, small), np.int32(0), true), known, true_classes)


def _segments(instance_ids: Int32, structure: UInt8) -> Int32:
    """Return the segment (V,) of each point: the id of its instance, or the negative `Structure`; 0 = none."""
    of_stuff = np.where(np.isin(structure, STUFF), -structure.astype(np.int32), np.int32(0))
    return np.where(instance_ids > 0, instance_ids, of_stuff)


def _matched(
    predicted: Int32, true: Int32, predicted_classes: Mapping[int, str], true_classes: Mapping[int, str]
) -> PanopticEvaluation:
    """Match the segments of V points.

    Args:
        predicted: The predicted segment (V,) of each point, as in `_segments`.
        true: The true segment (V,) of each point. Other instances than those in `true_classes` are void.
        predicted_classes: The class of each predicted instance that is evaluated.
        true_classes: The class of each evaluated ground-truth instance.
    """
    kinds = {-int(kind): kind.name.lower() for kind in STUFF}
    predicted_names, true_names = {**predicted_classes, **kinds}, {**true_classes, **kinds}
    rows, columns = (np.array(sorted(set(np.unique(of).tolist()) & of_class.keys()), np.int64) for of, of_class in (
        (predicted, predicted_names), (true, true_names)))  # fmt: skip
    points = contingency(predicted, true, rows, columns)
    overlap, void = points[1:, 1:], points[1:, 0]
    union = (points[1:].sum(axis=1) - void)[:, None] + points[:, 1:].sum(axis=0) - overlap
    same = np.array([[predicted_names[p] == true_names[t] and (p < 0) == (t < 0) for t in columns.tolist()]
                     for p in rows.tolist()], np.bool_).reshape(overlap.shape)  # fmt: skip
    iou = np.where(same, overlap / np.maximum(union, 1), 0.0)
    matches = iou > MATCH
    building = np.isin(true, (-Structure.FLOOR, -Structure.WALL))
    result = PanopticEvaluation({}, {}, float((predicted[building] > 0).mean()) if building.any() else 0.0)

    def of_class(segment: int, name: str) -> ClassQuality:
        classes: dict[str, ClassQuality] = result.stuff if segment < 0 else result.things  # type: ignore[assignment]
        return classes.setdefault(name, ClassQuality())

    for p, segment in enumerate(rows.tolist()):
        if matches[p].any():
            found = of_class(segment, predicted_names[segment])
            found.true_positives += 1
            found.iou += float(iou[p].max())
        elif void[p] <= VOID * points[1 + p].sum():
            of_class(segment, predicted_names[segment]).false_positives += 1
    for t, segment in enumerate(columns.tolist()):
        if not matches[:, t].any():
            of_class(segment, true_names[segment]).false_negatives += 1
    return result
