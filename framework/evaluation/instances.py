"""3D instance segmentation: average precision and overlap of a map's instances against the true ones.

The paper's figure is AP at IoU 0.5, averaged over classes. Labels are carried between map vertices and true surface
points by nearest neighbor, predictions are matched to truth greedily in order of confidence, and a class's AP is the
area under its precision-recall curve with all-point interpolation (the precision at a recall is the largest precision
at that or any higher recall, as in Pascal VOC from 2010 on), averaged over the classes that have a true instance.

**What is evaluated.** A true instance counts when its class is known and it has at least `min_points` points. The other
true instances (class None, or too few points) are *ignored* ones: something is there, but nobody can say whether a
detection of it is right. A prediction that finds no evaluated true instance is therefore left out, neither right nor
wrong, when

1. its best overlap among the ignored instances reaches the IoU threshold, or
2. more than half of its points lie on ignored instances: most of its evidence is where the truth is not known, or
3. its class is none of those that were looked for (`SceneTruth.classes`): a keyboard may well be there.

Every other prediction without a match is wrong; among them those on points of instance 0 (known to be no instance) and
those that no true point is near.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from framework.data import Array, Bool, Float32, Float64, Instance, InstanceMesh, Int32, Int64, SceneTruth
from framework.errors import DataError

MAX_DISTANCE = 0.05  # m, to the nearest neighbor that a label is taken from
MIN_POINTS = 100  # true instances with fewer points do not count
IOU_THRESHOLDS = tuple(percent / 100 for percent in range(50, 100, 5))  # those that `ap` averages over, COCO's


class Transfer(Enum):
    """Which way labels are carried; tables name it."""

    TO_TRUTH = "to_truth"  # each true point takes the instance of the nearest map vertex: the default
    TO_MAP = "to_map"  # each map vertex takes the instance of the nearest true point


@dataclass(frozen=True)
class PredictedInstances:
    """The K instances of a map, as labelled points and what is claimed about each."""

    points_world: Float32  # (V, 3) m, all of the map's surface: points of no instance take part in the transfer
    instance_ids: Int32  # (V,), 0 = no instance
    ids: Int64  # (K,) every instance of the map, also one without points
    confidences: Float64  # (K,) in [0, 1], ranks the instances
    class_names: tuple[str, ...]  # K, the most probable class of each

    def __post_init__(self) -> None:
        if not (len(self.ids) == len(self.confidences) == len(self.class_names)):
            raise DataError(
                f"PredictedInstances: {len(self.ids)} ids, {len(self.confidences)} confidences and "
                f"{len(self.class_names)} class names; there must be equally many"
            )
        if self.points_world.shape != (len(self.instance_ids), 3):
            raise DataError(
                f"PredictedInstances.points_world must be ({len(self.instance_ids)}, 3) like instance_ids, "
                f"found {self.points_world.shape}"
            )
        if len(np.unique(self.ids)) != len(self.ids) or (self.ids < 1).any():
            raise DataError("PredictedInstances.ids must be positive and each there once")
        if not np.isfinite(self.confidences).all():
            raise DataError("PredictedInstances.confidences holds values that are not finite")
        unlisted = np.setdiff1d(self.instance_ids, np.append(self.ids, 0))
        if len(unlisted):
            raise DataError(f"PredictedInstances: points are labelled {unlisted[0]}, which is not among the ids")

    @classmethod
    def of_map(
        cls, mesh: InstanceMesh, instances: Mapping[int, Instance], classes: Sequence[str]
    ) -> PredictedInstances:
        """All `instances` of a map with its `mesh`; `classes` name the columns of their class probabilities."""
        ids = sorted(instances)
        names = [classes[int(instances[key].class_probabilities.argmax())] for key in ids]
        return cls.on_mesh(mesh, ids, [instances[key].confidence for key in ids], names)

    @classmethod
    def on_mesh(
        cls, mesh: InstanceMesh, ids: Sequence[int], confidences: Sequence[float], class_names: Sequence[str]
    ) -> PredictedInstances:
        """What is claimed about each of the `ids`; vertices of other ids, tentative ones, are of no instance."""
        listed = np.array(ids, np.int64)
        return cls(
            points_world=mesh.vertices,
            instance_ids=np.where(np.isin(mesh.instance_ids, listed), mesh.instance_ids, 0).astype(np.int32),
            ids=listed,
            confidences=np.array(confidences, np.float64),
            class_names=tuple(class_names),
        )


@dataclass(frozen=True)
class Score:
    """How one class, or all of them together, fares at one IoU threshold."""

    ap: float  # area under the precision-recall curve
    true_positives: int
    false_positives: int
    ignored: int  # predictions that are neither
    truths: int  # true instances that count, at least 1
    matched_iou: float  # sum over the true positives

    @property
    def panoptic_quality(self) -> float:
        """Kirillov et al. 2019: matched IoU over TP + FP/2 + FN/2."""
        missed = self.truths - self.true_positives
        return self.matched_iou / (self.true_positives + 0.5 * self.false_positives + 0.5 * missed)


class Outcome(Enum):
    """What became of a prediction."""

    RIGHT = "right"  # matched with a true instance of its class
    WRONG_CLASS = "wrong class"  # it overlaps a true instance of another class enough
    FALSE = "false"  # it overlaps none enough, or one that a more confident prediction has found already
    IGNORED = "not judged"  # it lies where the truth is not known, or nobody looked for its class


@dataclass(frozen=True)
class Judgement:
    """One prediction against the truth."""

    id: int
    outcome: Outcome
    truth_id: int  # the true instance that it overlaps most, 0 = none; of a match the one that it is matched with
    truth_class: str | None  # None = not known
    iou: float  # with that one


@dataclass(frozen=True)
class InstanceEvaluation:
    """What `evaluate` found. Empty where the truth holds no instance that counts."""

    by_class: Mapping[float, Mapping[str, Score]]  # IoU threshold -> class with a true instance -> score
    agnostic: Mapping[float, Score]  # IoU threshold -> score with classes ignored
    overall: Score | None  # at IoU 0.5 over all predictions and all classes; a match must agree in class
    best_ious: Mapping[int, float]  # true instance that counts -> its best overlap with any prediction
    best_ids: Mapping[int, int]  # true instance that counts -> the prediction with that overlap, 0 = none

    def ap(self, threshold: float) -> float:
        """The class-averaged AP at one IoU threshold, `nan` without truth."""
        scores = self.by_class.get(threshold, {})
        return float(np.mean([score.ap for score in scores.values()])) if scores else float("nan")

    def metrics(self) -> dict[str, float]:
        """The figures by their names in metrics.json, in [0, 1] or counts; empty where nothing could be evaluated.

        `instances.`... over the classes with a true instance, or for one of them with `.<class>` behind it:

        - `ap50`, `ap25`: AP at IoU 0.5 and 0.25; `ap`: the mean over IOU_THRESHOLDS. Each also by class.
        - `ap50_agnostic`, `ap25_agnostic`: AP with all classes taken for one.
        - `mean_iou`: the best overlap of each true instance with a prediction of whatever class, averaged.
        - `precision50`, `recall50`, `f1_50`: at IoU 0.5, of all predictions and all true instances together.
        - `pq50`: the panoptic quality of each class at IoU 0.5, averaged.
        - `true_count`: true instances that count, also by class; `ignored_count`: predictions that are neither right
          nor wrong at IoU 0.5.
        """
        if self.overall is None:
            return {}
        tp, fp, truths = self.overall.true_positives, self.overall.false_positives, self.overall.truths
        flat = {
            "instances.ap50": self.ap(0.5),
            "instances.ap25": self.ap(0.25),
            "instances.ap": float(np.mean([self.ap(threshold) for threshold in IOU_THRESHOLDS])),
            "instances.ap50_agnostic": self.agnostic[0.5].ap,
            "instances.ap25_agnostic": self.agnostic[0.25].ap,
            "instances.mean_iou": float(np.mean(list(self.best_ious.values()))),
            "instances.precision50": tp / max(tp + fp, 1),
            "instances.recall50": tp / truths,
            "instances.f1_50": 2 * tp / (tp + fp + truths),
            "instances.pq50": float(np.mean([score.panoptic_quality for score in self.by_class[0.5].values()])),
            "instances.true_count": truths,
            "instances.ignored_count": self.overall.ignored,
        }
        for name, score in self.by_class[0.5].items():
            flat[f"instances.ap50.{name}"] = score.ap
            flat[f"instances.ap25.{name}"] = self.by_class[0.25][name].ap
            flat[f"instances.ap.{name}"] = float(np.mean([self.by_class[t][name].ap for t in IOU_THRESHOLDS]))
            flat[f"instances.true_count.{name}"] = score.truths
        return flat


def evaluate(
    predictions: PredictedInstances,
    truth: SceneTruth,
    *,
    transfer: Transfer = Transfer.TO_TRUTH,
    max_distance: float = MAX_DISTANCE,
    min_points: int = MIN_POINTS,
) -> InstanceEvaluation:
    """Compares a map's instances with the true ones: see the module's text for the rules.

    The result does not depend on the order of points or of predictions; equal confidences are ranked by id.
    """
    overlaps = _Overlaps.between(predictions, truth, transfer, max_distance, min_points)
    names = sorted(set(overlaps.truth_classes[overlaps.evaluated]))
    everything = np.ones(len(overlaps.predicted_ids), np.bool_)
    allowed = np.broadcast_to(overlaps.evaluated, overlaps.iou.shape)
    same_class = allowed & (overlaps.predicted_classes[:, None] == overlaps.truth_classes[None, :])
    by_class: dict[float, dict[str, Score]] = {}
    agnostic: dict[float, Score] = {}
    for threshold in (0.25, *IOU_THRESHOLDS):
        by_class[threshold] = {
            name: overlaps.score(
                threshold, overlaps.predicted_classes == name, overlaps.truth_classes == name, same_class
            )
            for name in names
        }
        if names:
            agnostic[threshold] = overlaps.score(threshold, everything, overlaps.evaluated, allowed)
    overall = overlaps.score(0.5, everything, overlaps.evaluated, same_class) if names else None
    best_ious, best_ids = overlaps.best()
    return InstanceEvaluation(by_class, agnostic, overall, best_ious, best_ids)


def judge(
    predictions: PredictedInstances, truth: SceneTruth, threshold: float = 0.5
) -> tuple[list[Judgement], dict[int, str]]:
    """What became of each prediction, best first, and the class of each true instance that counts and was missed.

    By the matching of `InstanceEvaluation.overall`: the counts are those of its score at that IoU.
    """
    overlaps = _Overlaps.between(predictions, truth, Transfer.TO_TRUTH, MAX_DISTANCE, MIN_POINTS)
    everything = np.ones(len(overlaps.predicted_ids), np.bool_)
    same_class = overlaps.evaluated & (overlaps.predicted_classes[:, None] == overlaps.truth_classes[None, :])
    matches = overlaps.matches(threshold, everything, same_class)
    judged = [overlaps.judgement(k, match, threshold) for k, match in matches]
    found = {one.truth_id for one in judged if one.outcome is Outcome.RIGHT}
    counted = zip(overlaps.truth_ids.tolist(), overlaps.truth_classes, overlaps.evaluated, strict=True)
    return judged, {key: name for key, name, counts in counted if counts and key not in found}


IGNORED, NO_MATCH = -2, -1  # in place of a true instance's column


@dataclass(frozen=True)
class _Overlaps:
    """K predictions, best first, against T true instances."""

    iou: Float64  # (K, T)
    ignorable: Bool  # (K,) more than half of the points on ignored instances, or of a class that nobody looked for
    predicted_ids: Int64  # (K,)
    predicted_classes: npt.NDArray[np.object_]  # (K,)
    truth_ids: Int64  # (T,)
    truth_classes: npt.NDArray[np.object_]  # (T,) name or None
    evaluated: Bool  # (T,) of a known class and large enough; the others are ignored

    @classmethod
    def between(
        cls,
        predictions: PredictedInstances,
        truth: SceneTruth,
        transfer: Transfer,
        max_distance: float,
        min_points: int,
    ) -> _Overlaps:
        truth_ids, truth_sizes = np.unique(truth.instance_ids[truth.instance_ids > 0], return_counts=True)
        ranks = np.lexsort((predictions.ids, -predictions.confidences))
        ids = predictions.ids[ranks]
        predicted, true = _transferred(predictions, truth, transfer, max_distance)
        points = _contingency(predicted, true, ids, truth_ids)
        intersection = points[1:, 1:]
        union = points[1:].sum(axis=1)[:, None] + points[:, 1:].sum(axis=0)[None, :] - intersection
        classes = np.array([truth.class_names.get(int(k)) for k in truth_ids], object)
        predicted_classes = np.array([predictions.class_names[k] for k in ranks], object)
        evaluated = (truth_sizes >= min_points) & np.array([name is not None for name in classes], np.bool_)
        mostly_ignored = 2 * intersection[:, ~evaluated].sum(axis=1) > points[1:].sum(axis=1)
        looked_for = truth.classes is None or np.isin(predicted_classes, truth.classes)
        return cls(
            iou=intersection / np.maximum(union, 1),
            ignorable=mostly_ignored | np.logical_not(looked_for),
            predicted_ids=ids,
            predicted_classes=predicted_classes,
            truth_ids=truth_ids.astype(np.int64),
            truth_classes=classes,
            evaluated=evaluated,
        )

    def score(self, threshold: float, predicted: Bool, truths: Bool, allowed: Bool) -> Score:
        """Matches the chosen predictions (K,) in order of confidence with true instances that are `allowed` (K, T)."""
        matches = self.matches(threshold, predicted, allowed)
        hits = [match >= 0 for _, match in matches if match != IGNORED]  # of the predictions that count, best first
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
        """Each of the chosen predictions (K,), best first, with the column of its match, NO_MATCH or IGNORED."""
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

    def judgement(self, k: int, match: int, threshold: float) -> Judgement:
        """Of prediction k with what `matches` says of it."""
        t = match if match >= 0 else int(self.iou[k].argmax()) if len(self.truth_ids) else -1
        iou = float(self.iou[k, t]) if t >= 0 else 0.0
        if match >= 0:
            outcome = Outcome.RIGHT
        elif match == IGNORED:
            outcome = Outcome.IGNORED
        else:
            other = iou >= threshold and self.truth_classes[t] != self.predicted_classes[k]
            outcome = Outcome.WRONG_CLASS if other else Outcome.FALSE
        near = iou > 0
        return Judgement(
            id=int(self.predicted_ids[k]),
            outcome=outcome,
            truth_id=int(self.truth_ids[t]) if near else 0,
            truth_class=self.truth_classes[t] if near else None,
            iou=iou,
        )

    def best(self) -> tuple[dict[int, float], dict[int, int]]:
        """For each evaluated true instance its best overlap and the prediction that has it, whatever its class."""
        ious, ids = {}, {}
        for t in np.flatnonzero(self.evaluated):
            column = self.iou[:, t]
            truth_id = int(self.truth_ids[t])
            ious[truth_id] = float(column.max(initial=0.0))
            ids[truth_id] = int(self.predicted_ids[column.argmax()]) if ious[truth_id] > 0 else 0
        return ious, ids


def average_precision(hits: Bool, truths: int) -> float:
    """The area under the precision-recall curve of ranked predictions (K,), True where right, of `truths` to be found.

    All-point interpolation: sum over the hits of max(precision at that or a lower rank) / truths.
    """
    if truths == 0:
        raise ValueError("average precision is not defined without a true instance")
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[hits].sum() / truths)


def _transferred(
    predictions: PredictedInstances, truth: SceneTruth, transfer: Transfer, max_distance: float
) -> tuple[Int32, Int32]:
    """Predicted and true instance ids at the same points, after the transfer."""
    if transfer is Transfer.TO_TRUTH:
        carried = transfer_labels(predictions.points_world, predictions.instance_ids, truth.points_world, max_distance)
        return carried, truth.instance_ids
    carried = transfer_labels(truth.points_world, truth.instance_ids, predictions.points_world, max_distance)
    return predictions.instance_ids, carried


def transfer_labels(points: Float32, labels: Int32, targets: Float32, max_distance: float) -> Int32:
    """The label of the nearest of `points` for each target, 0 where none is within `max_distance`."""
    if not len(points) or not len(targets):
        return np.zeros(len(targets), np.int32)
    import numba  # here: commands that only read figures are answered before it loads

    # Meshes come in an order that differs between runs: sorted, equally near points give the same label each time.
    order = np.lexsort((labels, points[:, 2], points[:, 1], points[:, 0]))
    points, labels = points[order], labels[order]
    tree = cKDTree(points, balanced_tree=False)
    bound = np.nextafter(max_distance, np.inf)  # exclusive in SciPy
    _, nearest = tree.query(targets, distance_upper_bound=bound, workers=numba.get_num_threads())
    carried: Int32 = np.append(labels, np.int32(0))[nearest]  # SciPy answers "none" with the index after the last
    return carried


def _contingency(predicted: Int32, true: Int32, predicted_ids: Int64, truth_ids: Array) -> Int64:
    """(1 + K, 1 + T) points with each pair of labels; row and column 0 hold the points of no instance."""
    rows, columns = _positions(predicted, predicted_ids), _positions(true, truth_ids)
    shape = 1 + len(predicted_ids), 1 + len(truth_ids)
    return np.bincount(rows * shape[1] + columns, minlength=shape[0] * shape[1]).reshape(shape)


def _positions(labels: Int32, ids: Array) -> Int64:
    """For each label 1 + its place in `ids`, 0 for label 0."""
    values, inverse = np.unique(labels, return_inverse=True)
    place = {int(value): 1 + k for k, value in enumerate(ids)}
    return np.array([place.get(int(value), 0) for value in values], np.int64)[inverse]
