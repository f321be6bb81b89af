"""Tests of the panoptic quality against a slow reference and on small examples."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest

from framework.data import Float32, SceneTruth, Structure
from framework.evaluation.instances import PredictedInstances
from framework.evaluation.panoptic import evaluate_panoptic

FLOOR, WALL, CEILING = Structure.FLOOR, Structure.WALL, Structure.CEILING


def line(count: int) -> Float32:
    """Return points 1 m apart, so that labels are transferred between equal points only."""
    return np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(np.float32)


def predicted(ids: list[int], structure: list[int], names: tuple[str, ...]) -> PredictedInstances:
    known = np.arange(1, len(names) + 1)
    labels = np.array(ids, np.int32)
    return PredictedInstances(line(len(ids)), labels, known, np.ones(len(names)), names, np.array(structure, np.uint8))


def true(ids: list[int], structure: list[int], names: dict[int, str | None]) -> SceneTruth:
    return SceneTruth(line(len(ids)), np.array(ids, np.int32), names, structure=np.array(structure, np.uint8))


def reference(predictions: PredictedInstances, truth: SceneTruth, min_points: int) -> dict[str, float]:
    """Return the panoptic quality of each class, by sets of points."""
    assert truth.structure is not None
    assert predictions.structure is not None
    segments: list[dict[tuple[str, int], set[int]]] = [defaultdict(set), defaultdict(set)]
    void = set(range(len(truth.instance_ids)))
    names = dict(zip(predictions.ids.tolist(), predictions.class_names, strict=True))
    for v, (own, kind) in enumerate(
        zip(predictions.instance_ids.tolist(), predictions.structure.tolist(), strict=True)
    ):
        if own or kind in (FLOOR, WALL, CEILING):
            segments[0][(names[own], own) if own else (Structure(kind).name.lower(), 0)].add(v)
    counts = np.bincount(truth.instance_ids)
    of_stuff = np.bincount(truth.structure[truth.instance_ids == 0], minlength=5)
    for v, (own, kind) in enumerate(zip(truth.instance_ids.tolist(), truth.structure.tolist(), strict=True)):
        name = truth.class_names.get(own) if own else Structure(kind).name.lower() if kind else None
        if name is not None and (counts[own] if own else of_stuff[kind]) >= min_points:
            segments[1][name, own].add(v)
            void.discard(v)
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    matched = set()
    for (name, own), points in segments[0].items():
        for (true_name, true_own), true_points in segments[1].items():
            if name == true_name and (own == 0) == (true_own == 0):
                iou = len(points & true_points) / len((points - void) | true_points)
                if iou > 0.5:
                    matched |= {("p", name, own), ("t", name, true_own)}
                    sums[name][0] += iou
                    sums[name][1] += 1
        if ("p", name, own) not in matched and 2 * len(points & void) <= len(points):
            sums[name][1] += 0.5
    for name, own in segments[1]:
        if ("t", name, own) not in matched:
            sums[name][1] += 0.5
    return {name: iou / count for name, (iou, count) in sums.items()}


@pytest.mark.parametrize("seed", range(20))
def test_panoptic_quality_equals_slow_reference(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.evaluation.panoptic.MIN_POINTS", 8)
    rng = np.random.default_rng(seed)
    ids, structure = np.repeat(rng.integers(0, 6, 24), 10), np.repeat(rng.integers(0, 4, 24), 10)
    structure[ids > 0] = 0
    truth = true(ids.tolist(), structure.tolist(), {1: "chair", 2: "chair", 3: "table", 4: None, 5: "bed"})
    noisy, noisy_structure = ids.copy(), structure.copy()
    changed = rng.random(len(ids)) < rng.uniform(0, 0.6)
    noisy[changed] = rng.integers(0, 6, changed.sum())
    noisy_structure[changed] = rng.integers(0, 5, changed.sum())
    found = predicted(noisy.tolist(), noisy_structure.tolist(), ("chair", "chair", "table", "bed", "bed"))
    result = evaluate_panoptic(found, truth)
    qualities = {name: one.pq for name, one in (result.things | result.stuff).items()}
    assert qualities == pytest.approx(reference(found, truth, 8))


def test_panoptic_metrics_average_over_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.evaluation.panoptic.MIN_POINTS", 1)
    truth = true([1] * 4 + [0] * 8, [0] * 4 + [FLOOR] * 4 + [WALL] * 4, {1: "chair"})
    found = predicted([1] * 4 + [0] * 8, [0] * 4 + [FLOOR] * 5 + [WALL] * 3, ("chair",))
    metrics = evaluate_panoptic(found, truth).metrics()
    assert metrics["panoptic.pq_things"] == 1
    assert metrics["panoptic.pq.floor"] == pytest.approx(4 / 5)
    assert metrics["panoptic.pq_stuff"] == pytest.approx((4 / 5 + 3 / 4) / 2)
    assert metrics["panoptic.pq"] == pytest.approx((1 + 4 / 5 + 3 / 4) / 3)


def test_panoptic_metrics_without_structure_are_empty() -> None:
    truth = SceneTruth(line(200), np.ones(200, np.int32), {1: "chair"})
    found = predicted([1] * 200, [0] * 200, ("chair",))
    assert evaluate_panoptic(found, truth).metrics() == {}


def test_panoptic_counts_building_in_instances(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.evaluation.panoptic.MIN_POINTS", 1)
    truth = true([1] * 4 + [0] * 12, [0] * 4 + [FLOOR] * 4 + [WALL] * 4 + [CEILING] * 4, {1: "chair"})
    found = predicted(
        [1] * 6 + [0] * 8 + [1] * 2, [0] * 6 + [FLOOR] * 2 + [WALL] * 4 + [CEILING] * 2 + [0] * 2, ("chair",)
    )
    assert evaluate_panoptic(found, truth).metrics()["panoptic.building_in_instances"] == 2 / 8


def test_panoptic_quality_ignores_small_stuff() -> None:
    """A ceiling with 99 points is void, so that a predicted wall on these points is no error."""
    structure = [FLOOR] * 100 + [WALL] * 100 + [CEILING] * 99
    truth = true([0] * 299, structure, {})
    found = evaluate_panoptic(predicted([0] * 299, [FLOOR] * 100 + [WALL] * 199, ()), truth)
    assert {name: quality.pq for name, quality in found.stuff.items()} == {"floor": 1.0, "wall": 1.0}
