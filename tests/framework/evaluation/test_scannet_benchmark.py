"""Tests for ScanNet's benchmark metrics. Results in random scenes are compared with a slow reference."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import SceneTruth
from framework.evaluation.instances import PredictedInstances
from framework.evaluation.scannet_benchmark import (
    BenchmarkScene,
    benchmark_metrics,
    scannet_ap,
    semantic_metrics,
)
from tests.support.slow_scannet import Mask, SceneFiles, slow_ious, slow_metrics

NAMES = {3: "cabinet", 5: "chair", 7: "table"}
POINTS = 1500


def points_of(labels: np.ndarray) -> np.ndarray:
    """Return points that are farther apart than the label transfer."""
    return np.stack([np.arange(len(labels)), np.zeros(len(labels)), np.zeros(len(labels))], axis=1).astype(np.float32)


def scene_of(
    predicted: np.ndarray, claims: dict[int, tuple[str, float]], true: np.ndarray, names: dict[int, str | None]
) -> BenchmarkScene:
    predictions = PredictedInstances(
        points_of(predicted),
        predicted.astype(np.int32),
        np.array(list(claims)),
        np.array([confidence for _, confidence in claims.values()]),
        tuple(name for name, _ in claims.values()),
    )
    truth = SceneTruth(points_of(true), true.astype(np.int32), names)
    return BenchmarkScene.of(predictions.instance_ids, predictions, truth, tuple(NAMES.values()))


def random_scene(seed: int) -> tuple[BenchmarkScene, SceneFiles]:
    """Return a scene with small, shifted, repeated, void and wrong instances."""
    rng = np.random.default_rng(seed)
    borders = np.sort(rng.integers(0, POINTS, 11))
    true_ids = rng.permutation(12)
    names = {int(k): rng.choice([*NAMES.values(), "lamp"]) if rng.uniform() < 0.85 else None for k in true_ids if k}
    true = true_ids[np.searchsorted(borders, np.arange(POINTS))]
    ids = 20 + rng.permutation(12)
    shifted = np.sort(borders + rng.normal(0, 20, 11).astype(int))
    predicted = np.where(rng.uniform(size=POINTS) < 0.95, ids[np.searchsorted(shifted, np.arange(POINTS))], 0)
    predicted[predicted == 20] = 0
    claims = {}
    for k, key in zip(ids.tolist(), true_ids.tolist(), strict=True):
        if k != 20:
            name = names.get(key) if rng.uniform() < 0.8 else rng.choice([*NAMES.values()])
            claims[k] = (str(name or "chair"), float(rng.choice([0.2, 0.5, 0.9])))
    claims = dict(sorted(claims.items()))
    number = {name: key for key, name in NAMES.items()}
    codes = [1000 * number.get(str(names.get(k)), 0) + k for k in true.tolist()]
    masks = [
        Mask(number.get(name, 99), confidence, set(np.flatnonzero(predicted == k).tolist()))
        for k, (name, confidence) in claims.items()
    ]
    return scene_of(predicted, claims, true, names), SceneFiles(masks, codes)


@pytest.mark.parametrize("seed", range(40))
def test_scannet_metrics_of_random_scene_equal_slow_reference(seed: int) -> None:
    scene, files = random_scene(seed)
    assert benchmark_metrics([scene], list(NAMES.values())) == pytest.approx(slow_metrics([files], NAMES), abs=1e-12)


def test_scannet_metrics_over_scenes_equal_slow_reference() -> None:
    drawn = [random_scene(seed) for seed in range(5)]
    fast = benchmark_metrics([scene for scene, _ in drawn], list(NAMES.values()))
    assert fast == pytest.approx(slow_metrics([files for _, files in drawn], NAMES), abs=1e-12)
    assert fast["instances.scannet.ap50"] not in (0, 1)


def test_scannet_ap_of_hit_before_false_positive_is_its_recall() -> None:
    true = np.repeat([1, 2], 200)
    predicted = np.repeat([3, 0, 4], [150, 60, 190])
    claims = {3: ("chair", 0.5), 4: ("chair", 0.9)}
    scene = scene_of(predicted, claims, true, {1: "chair", 2: "chair"})
    assert scannet_ap([scene], "chair", 0.5) == 1.0
    assert scannet_ap([scene], "chair", 0.8) == 0.5
    assert np.isnan(scannet_ap([scene], "table", 0.5))


def test_scannet_ap_prediction_on_void_is_ignored() -> None:
    true = np.repeat([1, 0], 200)
    predicted = np.repeat([3, 4], 200)
    claims = {3: ("chair", 0.5), 4: ("chair", 0.9)}
    of_void = scene_of(predicted, claims, true, {1: "chair"})
    assert scannet_ap([of_void], "chair", 0.5) == 1.0
    of_table = scene_of(predicted, claims, np.repeat([1, 2], 200), {1: "chair", 2: "table"})
    assert scannet_ap([of_table], "chair", 0.5) == pytest.approx((0 + 0.5) / 2)


def test_small_scannet_prediction_is_omitted() -> None:
    true = np.repeat([1, 2], [200, 99])
    claims = {3: ("chair", 0.5), 4: ("chair", 0.9)}
    scene = scene_of(np.repeat([3, 4], [200, 99]), claims, true, {1: "chair", 2: "table"})
    assert scannet_ap([scene], "chair", 0.5) == 1.0
    assert np.isnan(scannet_ap([scene], "cabinet", 0.5))


def test_scannet_metrics_without_predictions_are_zero() -> None:
    scene = scene_of(np.zeros(200, int), {}, np.ones(200, int), {1: "chair"})
    assert benchmark_metrics([scene], ["chair", "table"])["instances.scannet.ap"] == 0
    nothing = scene_of(np.zeros(200, int), {}, np.zeros(200, int), {})
    assert benchmark_metrics([nothing], ["chair"]) == {}


def test_semantic_metrics_equal_slow_reference() -> None:
    rng = np.random.default_rng(0)
    names = {1: "wall", 3: "cabinet", 5: "chair", 9: "window"}
    predicted, true = rng.integers(-1, 3, (2, 500)).astype(np.int32)  # no window
    keys = [*names, 0]
    slow = slow_ious([keys[k] for k in predicted], [1000 * keys[k] for k in true], names)
    assert semantic_metrics(predicted, true, list(names.values())) == pytest.approx(slow, abs=1e-12)
    assert "semantic.iou.window" not in slow
    assert semantic_metrics(predicted[:0], true[:0], list(names.values())) == {}
