"""Metrics of 3D instance segmentation: average precision, and overlap with ground-truth instances.

Labels are transferred between map vertices and ground-truth points by nearest neighbor. Predictions are matched to
ground-truth instances greedily, in order of confidence. AP is the area under the precision-recall curve of a class,
with all-point interpolation (Pascal VOC from 2010 on). It is averaged over the classes with a ground-truth instance.

A ground-truth instance is evaluated if its class is known and it has at least `min_points` points. All other
ground-truth instances are *ignored*. A prediction without a match is ignored in one of three cases:

1. Its best overlap with an ignored instance reaches the IoU threshold.
2. More than half of its points are on ignored instances.
3. Its class was not annotated (`SceneTruth.classes`).

All other predictions without a match are wrong. This includes predictions on points without an instance and predictions
far from the ground truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from framework.data import (
    LIKELY,
    Array,
    Bool,
    Float32,
    Float64,
    Instance,
    InstanceMesh,
    Int32,
    Int64,
    SceneTruth,
    UInt8,
)
from framework.errors import DataError
from framework.evaluation.calibration import Forecasts, calibration_metrics

MAX_DISTANCE = 0.05  # m, maximum distance of the nearest neighbor for the label transfer
MIN_POINTS = 100  # minimum number of points of an evaluated ground-truth instance
IOU_THRESHOLDS = tuple(percent / 100 for percent in range(50, 100, 5))  # averaged by `ap`, as in COCO


class Transfer(Enum):
    """The direction of the label transfer."""

    TO_TRUTH = "to_truth"  # each ground-truth point gets the instance of the nearest map vertex
    TO_MAP = "to_map"  # each map vertex gets the instance of the nearest ground-truth point


@dataclass(frozen=True)
class PredictedInstances:
    """The K instances of a map, as labeled points."""

    points_world: Float32  # (V, 3) m, the whole surface, because points without an instance are also transferred
    instance_ids: Int32  # (V,), 0 = no instance
    ids: Int64  # (K,) every instance of the map, including instances without points
    confidences: Float64  # (K,) in [0, 1]
    class_names: tuple[str, ...]  # (K,) most probable classes
    structure: UInt8 | None = None  # (V,) `Structure`; None = not determined
    # probabilities that an instance exists and that its class is right, by id; empty = unknown
    probabilities: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = {name: len(getattr(self, name)) for name in ("ids", "confidences", "class_names")}
        if len(set(counts.values())) > 1:
            raise DataError(
                f"PredictedInstances: expected ids, confidences and class_names of equal length, got {counts}"
            )
        shape = len(self.instance_ids), 3
        if self.points_world.shape != shape:
            raise DataError(f"PredictedInstances.points_world: expected shape {shape}, got {self.points_world.shape}")
        if len(np.unique(self.ids)) != len(self.ids) or (self.ids < 1).any():
            raise DataError(f"PredictedInstances.ids: expected unique positive integers, got {self.ids.tolist()!s:.60}")
        if not np.isfinite(self.confidences).all():
            raise DataError("PredictedInstances.confidences: expected finite values, got NaN or infinity")
        unlisted = np.setdiff1d(self.instance_ids, np.append(self.ids, 0))
        if len(unlisted):
            raise DataError(f"PredictedInstances.instance_ids: expected 0 or a value of `ids`, got {unlisted[0]}")

    @classmethod
    def of_map(
        cls, mesh: InstanceMesh, instances: Mapping[int, Instance], classes: Sequence[str]
    ) -> PredictedInstances:
        """Return all instances of a map.

        `classes` are the names of the columns of the class probabilities.
        """
        ids = sorted(instances)
        names = [classes[int(instances[key].class_probabilities.argmax())] for key in ids]
        probabilities = {key: one.probabilities for key, one in instances.items()}
        return cls.on_mesh(mesh, ids, [instances[key].confidence for key in ids], names, probabilities)

    @classmethod
    def on_mesh(
        cls,
        mesh: InstanceMesh,
        ids: Sequence[int],
        confidences: Sequence[float],
        class_names: Sequence[str],
        probabilities: Mapping[int, tuple[float, float]] | None = None,
    ) -> PredictedInstances:
        """Return the instances of a mesh with the given ids. Vertices of other instances get the id 0."""
        listed = np.array(ids, np.int64)
        return cls(
            points_world=mesh.vertices,
            instance_ids=np.where(np.isin(mesh.instance_ids, listed), mesh.instance_ids, 0).astype(np.int32),
            ids=listed,
            confidences=np.array(confidences, np.float64),
            class_names=tuple(class_names),
            probabilities=probabilities or {},
            structure=mesh.structure,
        )


@dataclass(frozen=True)
class Score:
    """The result of one class or of all classes together, at one IoU threshold."""

    ap: float  # area under the precision-recall curve
    true_positives: int
    false_positives: int
    ignored: int  # number of ignored predictions
    truths: int  # number of evaluated ground-truth instances, at least 1
    matched_iou: float  # sum of the IoUs of the true positives

    @property
    def precision(self) -> float:
        return self.true_positives / max(self.true_positives + self.false_positives, 1)

    @property
    def recall(self) -> float:
        return self.true_positives / self.truths

    @property
    def f1(self) -> float:
        return 2 * self.true_positives / (self.true_positives + self.false_positives + self.truths)

    @property
    def panoptic_quality(self) -> float:
        """Panoptic quality (Kirillov et al. 2019)."""
        missed = self.truths - self.true_positives
        return self.matched_iou / (self.true_positives + 0.5 * self.false_positives + 0.5 * missed)


class Outcome(Enum):
    """The result of one prediction."""

    RIGHT = "correct"  # matched with a ground-truth instance of its class
    WRONG_CLASS = "wrong class"  # IoU with a ground-truth instance of another class reaches the threshold
    FALSE = "false positive"  # insufficient IoU, or a duplicate of a more confident prediction
    IGNORED = "ignored"  # not evaluated; see the rules in the docstring of this module


@dataclass(frozen=True)
class MatchResult:
    """The comparison of one prediction with the ground truth."""

    id: int
    outcome: Outcome
    truth_id: int  # matched ground-truth instance, otherwise the instance with the largest overlap; 0 = none
    truth_class: str | None  # None = unknown
    iou: float  # IoU with this ground-truth instance


@dataclass(frozen=True)
class InstanceEvaluation:
    """The result of `evaluate`. It is empty without evaluated ground-truth instances."""

    by_class: Mapping[float, Mapping[str, Score]]  # IoU threshold -> class with a ground-truth instance -> score
    agnostic: Mapping[float, Score]  # IoU threshold -> class-agnostic score
    overall: Score | None  # at IoU 0.5, over all classes; matches have the same class
    likely: Score | None  # as `overall`, of the likely predictions; None = unknown probabilities
    best_ious: Mapping[int, float]  # evaluated ground-truth instance -> best IoU with a prediction
    best_ids: Mapping[int, int]  # evaluated ground-truth instance -> prediction with the best IoU, 0 = none
    forecasts: Mapping[str, Forecasts]  # probabilities that instances exist, and that their class is right

    def ap(self, threshold: float) -> float:
        """Return the AP at one IoU threshold, averaged over classes, or NaN without ground truth."""
        scores = self.by_class.get(threshold, {})
        return float(np.mean([score.ap for score in scores.values()])) if scores else float("nan")

    def metrics(self) -> dict[str, float]:
        """Return the metrics by their names in metrics.json.

        The result is empty without evaluated ground-truth instances.

        - `instances.ap50` and `ap25`: AP at IoU 0.5 and 0.25.
        - `ap`: mean AP over IOU_THRESHOLDS.
        - `ap50.<class>`, `ap25.<class>` and `ap.<class>`: AP of each class with a ground-truth instance.
        - `ap50_agnostic` and `ap25_agnostic`: class-agnostic AP.
        - `mean_iou`: mean of the best IoU of each ground-truth instance with a prediction of any class.
        - `precision50`, `recall50` and `f1_50`: at IoU 0.5, over all predictions and ground-truth instances.
        - `likely.precision50`, `likely.recall50` and `likely.f1_50`: over predictions with `exists` >= LIKELY.
        - `pq50`: panoptic quality at IoU 0.5, averaged over classes.
        - `true_count`: number of evaluated ground-truth instances, also for each class.
        - `ignored_count`: number of ignored predictions at IoU 0.5.
        - `ece.<event>`, `brier.<event>` and `auroc.<event>`: calibration (see framework/evaluation/calibration.py). The
          event is `exists` or `class`.
        - `calibration_count.<event>`: number of instances in these metrics.
        """
        if self.overall is None:
            return {}
        flat = {
            "instances.ap50": self.ap(0.5),
            "instances.ap25": self.ap(0.25),
            "instances.ap": float(np.mean([self.ap(threshold) for threshold in IOU_THRESHOLDS])),
            "instances.ap50_agnostic": self.agnostic[0.5].ap,
            "instances.ap25_agnostic": self.agnostic[0.25].ap,
            "instances.mean_iou": float(np.mean(list(self.best_ious.values()))),
            "instances.precision50": self.overall.precision,
            "instances.recall50": self.overall.recall,
            "instances.f1_50": self.overall.f1,
            "instances.pq50": float(np.mean([score.panoptic_quality for score in self.by_class[0.5].values()])),
            "instances.true_count": self.overall.truths,
            "instances.ignored_count": self.overall.ignored,
        }
        if self.likely is not None:
            flat["instances.likely.precision50"] = self.likely.precision
            flat["instances.likely.recall50"] = self.likely.recall
            flat["instances.likely.f1_50"] = self.likely.f1
        for name, score in self.by_class[0.5].items():
            flat[f"instances.ap50.{name}"] = score.ap
            flat[f"instances.ap25.{name}"] = self.by_class[0.25][name].ap
            flat[f"instances.ap.{name}"] = float(np.mean([self.by_class[t][name].ap for t in IOU_THRESHOLDS]))
            flat[f"instances.true_count.{name}"] = score.truths
        for event, forecasts in self.forecasts.items():
            flat |= calibration_metrics(forecasts, event)
        return flat


def evaluate(
    predictions: PredictedInstances,
    truth: SceneTruth,
    *,
    transfer: Transfer = Transfer.TO_TRUTH,
    max_distance: float = MAX_DISTANCE,
    min_points: int = MIN_POINTS,
) -> InstanceEvaluation:
    """Evaluate the instances of a map by the rules in the docstring of this module.

    The result does not depend on the order of points or predictions. Predictions of equal confidence are ranked by id.

    Args:
        predictions: Instances of the map.
        truth: Ground truth.
        transfer: Direction of the label transfer.
        max_distance: Maximum distance of the label transfer, m.
        min_points: Minimum number of points of an evaluated ground-truth instance.
    """
    overlaps = _Overlaps.between(predictions, truth, transfer, max_distance, min_points)
    names = sorted(set(overlaps.truth_classes[overlaps.evaluated]))
    everything = np.ones(len(overlaps.predicted_ids), np.bool_)
    allowed = np.broadcast_to(overlaps.evaluated, overlaps.iou.shape)
    same_class = allowed & (overlaps.predicted_classes[:, None] == overlaps.truth_classes[None, :])
    of_class = {name: (overlaps.predicted_classes == name, overlaps.truth_classes == name) for name in names}
    by_class, agnostic = {}, {}
    for threshold in (0.25, *IOU_THRESHOLDS):
        by_class[threshold] = {name: overlaps.score(threshold, *of_class[name], same_class) for name in names}
        if names:
            agnostic[threshold] = overlaps.score(threshold, everything, overlaps.evaluated, allowed)
    overall = overlaps.score(0.5, everything, overlaps.evaluated, same_class) if names else None
    best_ious, best_ids = overlaps.best()
    forecasts, likely = {}, None
    if names and (known := predictions.probabilities):
        forecasts = overlaps.forecasts(known)
        shown = np.array([known[int(key)][0] >= LIKELY for key in overlaps.predicted_ids], np.bool_)
        likely = overlaps.score(0.5, shown, overlaps.evaluated, same_class)
    return InstanceEvaluation(by_class, agnostic, overall, likely, best_ious, best_ids, forecasts)


def judge(
    predictions: PredictedInstances, truth: SceneTruth, threshold: float = 0.5
) -> tuple[list[MatchResult], dict[int, str]]:
    """Compare each prediction with the ground truth at one IoU threshold.

    Predictions are matched as for `InstanceEvaluation.overall`.

    Returns:
        The result of each prediction, in order of decreasing confidence, and the class of each evaluated ground-truth
        instance without a correct prediction, by id.
    """
    overlaps = _Overlaps.between(predictions, truth, Transfer.TO_TRUTH, MAX_DISTANCE, MIN_POINTS)
    everything = np.ones(len(overlaps.predicted_ids), np.bool_)
    same_class = overlaps.evaluated & (overlaps.predicted_classes[:, None] == overlaps.truth_classes[None, :])
    matches = overlaps.matches(threshold, everything, same_class)
    judged = [overlaps.match_result(k, match, threshold) for k, match in matches]
    found = {one.truth_id for one in judged if one.outcome is Outcome.RIGHT}
    counted = zip(overlaps.truth_ids.tolist(), overlaps.truth_classes, overlaps.evaluated, strict=True)
    return judged, {key: name for key, name, counts in counted if counts and key not in found}


def forecasts(predictions: PredictedInstances, truth: SceneTruth) -> dict[str, Forecasts]:
    """Return the forecasts of existence and of the class, by event; see `InstanceEvaluation.forecasts`."""
    overlaps = _Overlaps.between(predictions, truth, Transfer.TO_TRUTH, MAX_DISTANCE, MIN_POINTS)
    return overlaps.forecasts(predictions.probabilities)


def judge_class_agnostic(predictions: PredictedInstances, truth: SceneTruth) -> dict[int, tuple[bool, bool, float]]:
    """Return (exists, class is right, IoU) of each prediction that is not ignored, by id.

    They are defined in framework/evaluation/calibration.py.
    """
    overlaps = _Overlaps.between(predictions, truth, Transfer.TO_TRUTH, MAX_DISTANCE, MIN_POINTS)
    return {key: (exists, right, iou) for key, exists, right, iou in overlaps.class_agnostic()}


IGNORED, NO_MATCH = -2, -1  # results of a prediction without a matched ground-truth instance


@dataclass(frozen=True)
class _Overlaps:
    """The overlaps of K predictions with T ground-truth instances.

    Predictions are in order of decreasing confidence.
    """

    iou: Float64  # (K, T)
    ignorable: Bool  # (K,) True where most points are on ignored instances, or the class was not annotated
    predicted_ids: Int64  # (K,)
    predicted_classes: npt.NDArray[np.object_]  # (K,)
    truth_ids: Int64  # (T,)
    truth_classes: npt.NDArray[np.object_]  # (T,) name or None
    evaluated: Bool  # (T,) True where the class is known and the size sufficient; False = ignored

    @classmethod
    def between(
        cls, predictions: PredictedInstances, truth: SceneTruth, transfer: Transfer, reach: float, min_points: int
    ) -> _Overlaps:
        """Return the overlaps after a label transfer with the maximum distance `reach`, m."""
        truth_ids, truth_sizes = np.unique(truth.instance_ids[truth.instance_ids > 0], return_counts=True)
        ranks = np.lexsort((predictions.ids, -predictions.confidences))
        ids = predictions.ids[ranks]
        predicted, true, map_points = predictions.instance_ids, truth.instance_ids, predictions.points_world
        if transfer is Transfer.TO_TRUTH:
            predicted = transfer_labels(map_points, predicted, truth.points_world, reach)
        else:
            true = transfer_labels(truth.points_world, true, map_points, reach)
        points = contingency(predicted, true, ids, truth_ids)
        intersection = points[1:, 1:]
        union = points[1:].sum(axis=1)[:, None] + points[:, 1:].sum(axis=0)[None, :] - intersection
        classes = np.array([truth.class_names.get(int(k)) for k in truth_ids], object)
        predicted_classes = np.array([predictions.class_names[k] for k in ranks], object)
        evaluated = (truth_sizes >= min_points) & np.array([name is not None for name in classes], np.bool_)
        mostly_ignored = 2 * intersection[:, ~evaluated].sum(axis=1) > points[1:].sum(axis=1)
        annotated = truth.classes is None or np.isin(predicted_classes, truth.classes)
        return cls(
            iou=intersection / np.maximum(union, 1),
            ignorable=mostly_ignored | np.logical_not(annotated),
            predicted_ids=ids,
            predicted_classes=predicted_classes,
            truth_ids=truth_ids.astype(np.int64),
            truth_classes=classes,
            evaluated=evaluated,
        )

    def score(self, threshold: float, predicted: Bool, truths: Bool, allowed: Bool) -> Score:
        """Return the score of selected predictions and ground-truth instances.

        Args:
            threshold: IoU threshold.
            predicted: Mask (K,) of the selected predictions.
            truths: Mask (T,) of the selected ground-truth instances.
            allowed: Mask (K, T) of the pairs that may match.
        """
        matches = self.matches(threshold, predicted, allowed)
        hits = [match >= 0 for _, match in matches if match != IGNORED]  # evaluated predictions
        count = int((truths & self.evaluated).sum())
        return Score(
            ap=average_precision(np.array(hits, np.bool_), count),
            true_positives=sum(hits),
            false_positives=len(hits) - sum(hits),
            ignored=len(matches) - len(hits),
            truths=count,
            matched_iou=sum(float(self.iou[k, match]) for k, match in matches if match >= 0),
        )

    def matches(self, threshold: float, predicted: Bool, allowed: Bool) -> list[tuple[int, int]]:
        """Return the index of each selected prediction and of its matched ground-truth instance.

        The second index is NO_MATCH or IGNORED for predictions without a match. The arguments are described in `score`.
        """
        ignored_iou = self.iou[:, ~self.evaluated].max(axis=1, initial=0.0)
        unknown = self.ignorable | (ignored_iou >= threshold)
        free = np.ones(len(self.truth_ids), np.bool_)
        found: list[tuple[int, int]] = []
        for k in np.flatnonzero(predicted).tolist():
            candidates = np.where(allowed[k] & free, self.iou[k], 0.0)
            best = int(candidates.argmax()) if len(candidates) else -1
            if best >= 0 and candidates[best] >= threshold:
                free[best] = False
                found.append((k, best))
            else:
                found.append((k, IGNORED if unknown[k] else NO_MATCH))
        return found

    def class_agnostic(self) -> Iterator[tuple[int, bool, bool, float]]:
        """Yield (id, exists, class is right, IoU) for each prediction that is not ignored.

        The IoU is that with the matched ground-truth instance, otherwise the largest one.
        """
        allowed = np.broadcast_to(self.evaluated, self.iou.shape)
        for k, match in self.matches(0.5, np.ones(len(self.iou), np.bool_), allowed):
            if match != IGNORED:
                exists = match >= 0
                right = exists and self.predicted_classes[k] == self.truth_classes[match]
                iou = self.iou[k, match] if exists else self.iou[k].max(initial=0.0)
                yield int(self.predicted_ids[k]), exists, bool(right), float(iou)

    def forecasts(self, probabilities: Mapping[int, tuple[float, float]]) -> dict[str, Forecasts]:
        """Return the forecasts of existence and of the class, given both probabilities of each prediction."""
        judged = list(self.class_agnostic())
        return {
            "exists": Forecasts.of((probabilities[key][0], exists) for key, exists, _, _ in judged),
            "class": Forecasts.of((probabilities[key][1], right) for key, exists, right, _ in judged if exists),
        }

    def match_result(self, k: int, match: int, threshold: float) -> MatchResult:
        """Return the result of prediction `k`, given its match and the IoU threshold."""
        t = match if match >= 0 else int(self.iou[k].argmax()) if len(self.truth_ids) else -1
        iou = float(self.iou[k, t]) if t >= 0 else 0.0
        truth_id, truth_class = (int(self.truth_ids[t]), self.truth_classes[t]) if iou > 0 else (0, None)
        outcome = Outcome.RIGHT if match >= 0 else Outcome.IGNORED if match == IGNORED else Outcome.FALSE
        if match == NO_MATCH and iou >= threshold and truth_class != self.predicted_classes[k]:
            outcome = Outcome.WRONG_CLASS
        return MatchResult(int(self.predicted_ids[k]), outcome, truth_id, truth_class, iou)

    def best(self) -> tuple[dict[int, float], dict[int, int]]:
        """Return the best IoU and the best prediction of each evaluated ground-truth instance, by id.

        The best prediction is 0 for instances without overlap.
        """
        columns = {int(self.truth_ids[t]): self.iou[:, t] for t in np.flatnonzero(self.evaluated)}
        ious = {key: float(column.max(initial=0.0)) for key, column in columns.items()}
        ids = {key: int(self.predicted_ids[columns[key].argmax()]) if iou > 0 else 0 for key, iou in ious.items()}
        return ious, ids


def average_precision(hits: Bool, truths: int) -> float:
    """Return the area under the precision-recall curve, with all-point interpolation.

    Args:
        hits: Ranked predictions (K,), True = correct.
        truths: Number of ground-truth instances, at least 1.
    """
    if truths == 0:
        raise ValueError("average precision: expected at least one ground-truth instance, got none")
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]  # best precision at the same or a higher recall
    return float(envelope[hits].sum() / truths)


def transfer_labels(points: Float32, labels: Int32, targets: Float32, max_distance: float) -> Int32:
    """Return the label (T,) of the nearest point for each target.

    Args:
        points: Labeled points (P, 3), m.
        labels: Label of each point (P,).
        targets: Points without labels (T, 3), m.
        max_distance: Maximum distance, m. Targets without a point within this distance get the label 0.
    """
    if not len(points) or not len(targets):
        return np.zeros(len(targets), np.int32)
    import numba  # imported here to keep commands that only read metrics fast

    # The order of vertices differs between runs. Sorting makes ties deterministic.
    order = np.lexsort((labels, points[:, 2], points[:, 1], points[:, 0]))
    points, labels = points[order], labels[order]
    tree = cKDTree(points, balanced_tree=False)
    bound = np.nextafter(max_distance, np.inf)  # SciPy's bound is exclusive
    _, nearest = tree.query(targets, distance_upper_bound=bound, workers=numba.get_num_threads())
    transferred: Int32 = np.append(labels, np.int32(0))[nearest]  # SciPy returns the index after the last for "none"
    return transferred


def contingency(predicted: Int32, true: Int32, predicted_ids: Int64, truth_ids: Array) -> Int64:
    """Return the number of points (1 + K, 1 + T) with each pair of labels.

    Row 0 and column 0 are for points without an instance.
    """
    rows, columns = _positions(predicted, predicted_ids), _positions(true, truth_ids)
    shape = 1 + len(predicted_ids), 1 + len(truth_ids)
    return np.bincount(rows * shape[1] + columns, minlength=shape[0] * shape[1]).reshape(shape)


def _positions(labels: Int32, ids: Array) -> Int64:
    """Return 1 + the index of each label in `ids`, and 0 for the label 0."""
    values, inverse = np.unique(labels, return_inverse=True)
    index = {value: k for k, value in enumerate(ids.tolist(), start=1)}
    return np.array([index.get(value, 0) for value in values.tolist()], np.int64)[inverse]
