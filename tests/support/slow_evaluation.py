"""Slow reference for the instance evaluation, based only on the docstrings of framework.evaluation.instances."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from framework.data import SceneTruth
from framework.evaluation.instances import PredictedInstances, Transfer

THRESHOLDS = [Fraction(percent, 100) for percent in range(50, 100, 5)]
Pairs = list[tuple[int, int]]  # predicted and true id of each point, 0 = none


@dataclass
class Matched:
    """Result of one pass over the predictions."""

    hits: list[bool]
    ignored: int
    matched_iou: Fraction
    truths: int

    @property
    def ap(self) -> Fraction:
        """Return the average precision, i.e. the mean of the best precision at each recall k / truths or above."""
        total = Fraction(0)
        for k in range(1, self.truths + 1):
            precisions = [
                Fraction(sum(self.hits[:rank]), rank)
                for rank in range(1, len(self.hits) + 1)
                if sum(self.hits[:rank]) >= k
            ]
            total += max(precisions, default=Fraction(0))
        return total / self.truths

    @property
    def panoptic_quality(self) -> Fraction:
        tp = sum(self.hits)
        return self.matched_iou / (tp + Fraction(len(self.hits) - tp, 2) + Fraction(self.truths - tp, 2))


def slow_metrics(
    predictions: PredictedInstances, truth: SceneTruth, transfer: Transfer, max_distance: float, min_points: int
) -> dict[str, float]:
    """Return the metrics with the same keys as `evaluate(...).metrics()`."""
    pairs = _pairs(predictions, truth, transfer, max_distance)
    sizes = {t: int((truth.instance_ids == t).sum()) for t in set(truth.instance_ids.tolist()) - {0}}
    classes = {t: truth.class_names.get(t) for t, size in sizes.items() if size >= min_points}
    counted = {t: name for t, name in classes.items() if name is not None}
    ignored = sorted(sizes.keys() - counted.keys())
    if not counted:
        return {}
    claims = dict(zip(predictions.ids.tolist(), predictions.class_names, strict=True))
    confidences = dict(zip(predictions.ids.tolist(), predictions.confidences.tolist(), strict=True))
    ranked = sorted(claims, key=lambda p: (-confidences[p], p))

    def iou(p: int, t: int) -> Fraction:
        both = sum(pair == (p, t) for pair in pairs)
        either = sum(pair[0] == p or pair[1] == t for pair in pairs)
        return Fraction(both, either) if either else Fraction(0)

    overlap = {(p, t): iou(p, t) for p in claims for t in sizes}

    def unknown(p: int, threshold: Fraction) -> bool:
        on_ignored = sum(pair[0] == p and pair[1] in ignored for pair in pairs)
        mostly = 2 * on_ignored > sum(pair[0] == p for pair in pairs)
        return mostly or any(overlap[p, t] >= threshold for t in ignored)

    def match(threshold: Fraction, of: str | None, by_class: bool) -> Matched:
        """Match the predictions of the class `of` (None = all). With `by_class`, only equal classes match."""
        chosen = [t for t, name in counted.items() if of in (None, name)]
        found = Matched([], 0, Fraction(0), len(chosen))
        free = set(counted)
        for p in ranked:
            if of not in (None, claims[p]):
                continue
            fitting = [t for t in sorted(free) if not by_class or counted[t] == claims[p]]
            best = max(fitting, key=lambda t: overlap[p, t], default=None)
            if best is not None and overlap[p, best] >= threshold:
                free.remove(best)
                found.hits.append(True)
                found.matched_iou += overlap[p, best]
            elif unknown(p, threshold):
                found.ignored += 1
            else:
                found.hits.append(False)
        return found

    def mean(values: list[Fraction]) -> float:
        return float(sum(values) / len(values))

    half, quarter = Fraction(1, 2), Fraction(1, 4)
    names = sorted(set(counted.values()))
    overall = match(half, None, by_class=True)
    tp = sum(overall.hits)
    figures = {
        "ap50": mean([match(half, name, True).ap for name in names]),
        "ap25": mean([match(quarter, name, True).ap for name in names]),
        "ap": mean([match(threshold, name, True).ap for name in names for threshold in THRESHOLDS]),
        "ap50_agnostic": float(match(half, None, by_class=False).ap),
        "ap25_agnostic": float(match(quarter, None, by_class=False).ap),
        "mean_iou": mean([max((overlap[p, t] for p in claims), default=Fraction(0)) for t in counted]),
        "precision50": tp / len(overall.hits) if overall.hits else 0.0,
        "recall50": tp / len(counted),
        "f1_50": 2 * tp / (len(overall.hits) + len(counted)),
        "pq50": mean([match(half, name, True).panoptic_quality for name in names]),
        "true_count": len(counted),
        "ignored_count": overall.ignored,
    }
    for name in names:
        figures[f"ap50.{name}"] = float(match(half, name, True).ap)
        figures[f"ap25.{name}"] = float(match(quarter, name, True).ap)
        figures[f"ap.{name}"] = mean([match(threshold, name, True).ap for threshold in THRESHOLDS])
        figures[f"true_count.{name}"] = sum(of == name for of in counted.values())
    return {f"instances.{name}": value for name, value in figures.items()}


def _pairs(predictions: PredictedInstances, truth: SceneTruth, transfer: Transfer, max_distance: float) -> Pairs:
    predicted, true = predictions.instance_ids, truth.instance_ids
    if transfer is Transfer.TO_TRUTH:
        predicted = _carried(predictions.points_world, predicted, truth.points_world, max_distance)
    else:
        true = _carried(truth.points_world, true, predictions.points_world, max_distance)
    return list(zip(predicted, true, strict=True)) if len(predicted) else []


def _carried(points: np.ndarray, labels: np.ndarray, targets: np.ndarray, max_distance: float) -> list[int]:
    carried = []
    for target in targets.astype(np.float64):
        distances = np.linalg.norm(points - target, axis=1)
        near = len(points) > 0 and distances.min() <= max_distance
        carried.append(int(labels[distances.argmin()]) if near else 0)
    return carried
