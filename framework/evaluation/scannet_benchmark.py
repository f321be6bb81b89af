"""Metrics of ScanNet's benchmarks of 3D instance and semantic segmentation, computed by their published rules.

The rules are those of the benchmark scripts (Dai et al. 2017, kaldir.vc.in.tum.de/scannet_benchmark, and Rozenberszki
et al. 2022 for ScanNet200). Instances:

1. Predictions of benchmark classes and ground-truth instances are evaluated if they have at least MIN_POINTS points.
2. A ground-truth instance, in the order of the ids, is matched with the first unmatched prediction of its class whose
   IoU is above the threshold. Further unmatched predictions above the threshold are false positives; the match gets the
   highest of their confidences.
3. A prediction without a ground-truth instance above the threshold is a false positive, unless its fraction of points
   on ignored points is above the threshold. Ignored points are those without an instance of a benchmark class, and
   those of instances below MIN_POINTS of the class of the prediction.
4. AP is the area under the precision-recall curve, by the trapezoidal rule between its points. Predictions of equal
   confidence form one point of the curve, and the last point is precision 1 at recall 0.
5. AP is averaged over THRESHOLDS and the classes with a ground-truth instance. AP50 and AP25 have one threshold.

Semantic segmentation: the IoU of each class over all ground-truth points of benchmark classes, averaged over classes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from framework.data import Array, Float64, Int32, Int64, SceneTruth
from framework.evaluation.instances import PredictedInstances, contingency

MIN_POINTS = 100
THRESHOLDS = tuple(percent / 100 for percent in range(50, 95, 5))  # averaged by AP; 0.95 is not included
LOW_THRESHOLD = 0.25


@dataclass(frozen=True)
class BenchmarkScene:
    """The overlaps of K evaluated predictions with all T ground-truth instances of benchmark classes in one scene."""

    intersections: Int64  # (K, T) points
    predicted_points: Int64  # (K,)
    void_points: Int64  # (K,) points without an instance of a benchmark class
    predicted_classes: npt.NDArray[np.object_]  # (K,) names
    confidences: Float64  # (K,)
    truth_points: Int64  # (T,)
    truth_classes: npt.NDArray[np.object_]  # (T,) names

    @classmethod
    def of(
        cls, labels: Int32, predictions: PredictedInstances, truth: SceneTruth, classes: Sequence[str]
    ) -> BenchmarkScene:
        """Return the overlaps on the ground-truth points.

        Args:
            labels: The predicted instance of each ground-truth point (V,), 0 = none.
            predictions: The instances of a map, with classes of the benchmark or other classes.
            truth: The ground truth. Instances of other classes are void.
            classes: The classes of the benchmark.
        """
        present = np.unique(truth.instance_ids)
        truth_ids = present[[truth.class_names.get(k) in classes for k in present.tolist()]]
        kept = [k for k, name in enumerate(predictions.class_names) if name in classes]
        points = contingency(labels, truth.instance_ids, predictions.ids[kept], truth_ids)
        sizes = points[1:].sum(axis=1)
        large = np.flatnonzero(sizes >= MIN_POINTS)
        chosen = [kept[k] for k in large]
        return cls(
            intersections=points[1:, 1:][large],
            predicted_points=sizes[large],
            void_points=points[1:, 0][large],
            predicted_classes=np.array([predictions.class_names[k] for k in chosen], object),
            confidences=predictions.confidences[chosen],
            truth_points=points[:, 1:].sum(axis=0),
            truth_classes=np.array([truth.class_names[int(k)] for k in truth_ids], object),
        )


def scannet_ap(scenes: Sequence[BenchmarkScene], class_name: str, threshold: float) -> float:
    """Return the AP of a class over all scenes at one IoU threshold, or NaN without ground-truth instances."""
    outcomes = [_outcomes(scene, class_name, threshold) for scene in scenes]
    hits, scores = (np.concatenate([one[k] for one in outcomes]) for k in (0, 1))
    missed = sum(one[2] for one in outcomes)
    total = int(hits.sum()) + missed
    if not total:
        return float("nan")
    if not len(hits):
        return 0.0
    order = np.argsort(-scores, kind="stable")
    last = np.flatnonzero(np.append(np.diff(scores[order]) != 0, True))  # the last prediction of each confidence
    true = np.cumsum(hits[order])[last]
    precision, recall = np.append(1.0, true / (last + 1)), np.append(0.0, true / total)
    return float(np.sum((precision[1:] + precision[:-1]) / 2 * np.diff(recall)))


def _outcomes(scene: BenchmarkScene, class_name: str, threshold: float) -> tuple[Array, Float64, int]:
    """Return the hits (N,) and confidences (N,) of the counted predictions, and the number of missed instances."""
    rows = np.flatnonzero(scene.predicted_classes == class_name)
    columns = np.flatnonzero(scene.truth_classes == class_name)
    shared = scene.intersections[np.ix_(rows, columns)]
    predicted, true = scene.predicted_points[rows], scene.truth_points[columns]
    overlaps = shared / (predicted[:, None] + true[None, :] - shared) > threshold
    large = true >= MIN_POINTS
    matched = np.zeros(len(rows), np.bool_)
    hits, scores, missed = list[bool](), list[float](), 0
    for column in np.flatnonzero(large):
        free = np.flatnonzero(overlaps[:, column] & ~matched)
        if not len(free):
            missed += 1
            continue
        matched[free[0]] = True
        ranked = np.sort(scene.confidences[rows[free]])[::-1]
        hits += [True] + [False] * (len(free) - 1)
        scores += ranked.tolist()
    ignored = scene.void_points[rows] + shared[:, ~large].sum(axis=1)
    for k in np.flatnonzero(~overlaps.any(axis=1)):
        if ignored[k] / predicted[k] <= threshold:
            hits.append(False)
            scores.append(float(scene.confidences[rows[k]]))
    return np.array(hits, np.bool_), np.array(scores, np.float64), missed


def benchmark_metrics(scenes: Sequence[BenchmarkScene], classes: Sequence[str]) -> dict[str, float]:
    """Return the instance metrics over all scenes by their names in metrics.json.

    The result is empty without ground-truth instances. The keys are `instances.scannet.ap`, `ap50` and `ap25`, and
    these with the name of each class with a ground-truth instance, such as `instances.scannet.ap50.chair`.
    """
    found: dict[str, dict[str, float]] = {"ap": {}, "ap50": {}, "ap25": {}}
    for name in classes:
        values = [scannet_ap(scenes, name, threshold) for threshold in (*THRESHOLDS, LOW_THRESHOLD)]
        if not np.isnan(values[0]):
            found["ap"][name], found["ap50"][name] = float(np.mean(values[:-1])), values[0]
            found["ap25"][name] = values[-1]
    if not found["ap"]:
        return {}
    means = {f"instances.scannet.{key}": float(np.mean(list(of.values()))) for key, of in found.items()}
    return means | {f"instances.scannet.{key}.{name}": value for key, of in found.items() for name, value in of.items()}


def semantic_metrics(predicted: Int32, true: Int32, classes: Sequence[str]) -> dict[str, float]:
    """Return the semantic metrics by their names in metrics.json: `semantic.miou` and `semantic.iou.<class>`.

    Classes that occur in neither the ground truth nor the prediction are omitted.

    Args:
        predicted: The index in `classes` of each ground-truth point (V,), -1 = no class of the benchmark.
        true: The index in `classes` of each ground-truth point (V,), -1 = ignored.
        classes: The classes of the benchmark.
    """
    size = len(classes) + 1
    counted = true >= 0
    pairs = size * true[counted].astype(np.int64) + predicted[counted] % size  # the last column has no class
    confusion = np.bincount(pairs, minlength=size * size).reshape(size, size)
    both = np.diag(confusion)[:-1]
    union = confusion[:-1].sum(axis=1) + confusion[:, :-1].sum(axis=0) - both
    ious = {name: float(both[k] / union[k]) for k, name in enumerate(classes) if union[k]}
    mean = {"semantic.miou": float(np.mean(list(ious.values())))} if ious else {}
    return mean | {f"semantic.iou.{name}": value for name, value in ious.items()}
