"""Slow reference for ScanNet's benchmark metrics, computed from prediction and ground-truth files by their rules.

The rules are those in the docstring of framework.evaluation.scannet_benchmark, in the terms of the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

MIN_POINTS = 100


@dataclass
class Mask:
    """A predicted instance."""

    class_id: int
    confidence: float
    points: set[int]


@dataclass
class SceneFiles:
    """The predictions and the ground truth of a scene."""

    masks: list[Mask]
    codes: list[int]  # of each point: 1000 * class id + instance

    @classmethod
    def read(cls, predictions: Path, ground_truth: Path) -> SceneFiles:
        masks = []
        for line in predictions.read_text().splitlines():
            name, class_id, confidence = line.split()
            values = (predictions.parent / name).read_text().split()
            masks.append(Mask(int(class_id), float(confidence), {k for k, value in enumerate(values) if value != "0"}))
        return cls(masks, [int(word) for word in ground_truth.read_text().split()])

    @cached_property
    def points(self) -> dict[int, set[int]]:
        """Points by code."""
        found: dict[int, set[int]] = {}
        for k, code in enumerate(self.codes):
            found.setdefault(code, set()).add(k)
        return dict(sorted(found.items()))

    def truths(self, class_id: int) -> dict[int, set[int]]:
        return {code: points for code, points in self.points.items() if code // 1000 == class_id}

    def void(self, class_ids: list[int]) -> set[int]:
        return set().union(*(points for code, points in self.points.items() if code // 1000 not in class_ids))


def overlap(one: set[int], other: set[int]) -> float:
    return len(one & other) / len(one | other)


def slow_ap(scenes: list[SceneFiles], class_id: int, class_ids: list[int], threshold: float) -> float | None:
    """Return the AP of a class, or None without ground-truth instances."""
    judged: list[tuple[float, bool]] = []
    missed = 0
    any_truth = False
    for scene in scenes:
        masks = [mask for mask in scene.masks if mask.class_id == class_id and len(mask.points) >= MIN_POINTS]
        truths = scene.truths(class_id)
        used: list[Mask] = []
        for truth in truths.values():
            if len(truth) < MIN_POINTS:
                continue
            any_truth = True
            close = [mask for mask in masks if mask not in used and overlap(mask.points, truth) > threshold]
            if not close:
                missed += 1
                continue
            used.append(close[0])
            confidences = sorted((mask.confidence for mask in close), reverse=True)
            judged += [(confidences[0], True), *((confidence, False) for confidence in confidences[1:])]
        for mask in masks:
            if any(overlap(mask.points, truth) > threshold for truth in truths.values()):
                continue
            ignored = mask.points & scene.void(class_ids)
            for truth in truths.values():
                if len(truth) < MIN_POINTS:
                    ignored |= mask.points & truth
            if len(ignored) / len(mask.points) <= threshold:
                judged.append((mask.confidence, False))
    if not any_truth:
        return None
    curve = []
    for least in sorted({confidence for confidence, _ in judged}):
        kept = [hit for confidence, hit in judged if confidence >= least]
        total = sum(hit for _, hit in judged) + missed
        curve.append((sum(kept) / len(kept), sum(kept) / total))
    curve.append((1.0, 0.0))
    return sum((p + q) / 2 * (r - s) for (p, r), (q, s) in pairwise(curve))


def slow_metrics(scenes: list[SceneFiles], names: dict[int, str]) -> dict[str, float]:
    """Return the metrics with the keys of metrics.json. `names` are the benchmark classes without background by id."""
    found: dict[str, float] = {}
    thresholds = [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9]
    for class_id, name in names.items():
        values = [slow_ap(scenes, class_id, list(names), threshold) for threshold in thresholds]
        low = slow_ap(scenes, class_id, list(names), 0.25)
        if low is not None:
            known = [value for value in values if value is not None]
            found[f"instances.scannet.ap.{name}"] = sum(known) / len(known)
            found[f"instances.scannet.ap50.{name}"] = known[0]
            found[f"instances.scannet.ap25.{name}"] = low
    for key in ("ap", "ap50", "ap25"):
        values = [value for name, value in found.items() if name.startswith(f"instances.scannet.{key}.")]
        if values:
            found[f"instances.scannet.{key}"] = sum(values) / len(values)
    return found


def slow_ious(predicted: list[int], codes: list[int], names: dict[int, str]) -> dict[str, float]:
    """Return the semantic metrics. `names` are all classes of the benchmark by id."""
    pairs = [(ours, code // 1000) for ours, code in zip(predicted, codes, strict=True) if code // 1000 in names]
    found = {}
    for class_id, name in names.items():
        union = sum(class_id in pair for pair in pairs)
        if union:
            found[f"semantic.iou.{name}"] = sum(pair == (class_id, class_id) for pair in pairs) / union
    return found | {"semantic.miou": sum(found.values()) / len(found)}
