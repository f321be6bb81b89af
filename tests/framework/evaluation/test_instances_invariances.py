"""Tests for invariances of instance AP in random scenes. Results are compared with a slow reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from framework.data import SceneTruth
from framework.evaluation.instances import (
    IOU_THRESHOLDS,
    MAX_DISTANCE,
    InstanceEvaluation,
    PredictedInstances,
    Transfer,
    evaluate,
)
from tests.support.slow_evaluation import slow_metrics

MIN_POINTS = 12  # minimum number of points of an evaluated ground-truth instance in these small scenes
CLASSES = ("chair", "bed", "couch")
CLEAR = 1e-5  # m, margin between nearest-neighbor distances; larger than rounding errors

examples = settings(derandomize=True, deadline=None, max_examples=30)


@dataclass
class Drawn:
    """Random scene of slabs along x, and a map of the scene with shifted borders. Some classes are unknown."""

    truth: SceneTruth
    predictions: PredictedInstances
    rng: np.random.Generator

    def evaluate(self, transfer: Transfer, min_points: int = MIN_POINTS) -> InstanceEvaluation:
        return evaluate(self.predictions, self.truth, transfer=transfer, min_points=min_points)


@st.composite
def scenes(draw: st.DrawFn, unknown: bool = True) -> Drawn:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    names = [*CLASSES, *([None] * unknown)]
    points = rng.uniform(0, (1.2, 0.15, 0.15), (rng.integers(100, 160), 3))
    borders = np.sort(rng.uniform(0, 1.2, 6))
    true_ids = rng.permutation([0, 2, 3, 5, 7, 8, 11])
    class_names = {int(k): names[rng.integers(len(names))] for k in true_ids if k}

    seen = points[rng.uniform(size=len(points)) < 0.9]
    seen = np.concatenate([seen, rng.uniform(0, 1.5, (20, 3))]) + rng.normal(0, 0.015, (len(seen) + 20, 3))
    ids = rng.permutation([0, 1, 4, 6, 9, 10, 13])
    claims = {20: "chair"}  # a prediction without points
    for k, true_id in zip(ids.tolist(), true_ids.tolist(), strict=True):
        right = rng.uniform() < 0.8
        claims[k] = (class_names.get(true_id) if right else None) or str(rng.choice([*CLASSES, "tv"]))
    claims.pop(0)
    return Drawn(
        SceneTruth(points.astype(np.float32), _slabs(points, true_ids, borders), class_names),
        PredictedInstances(
            seen.astype(np.float32),
            _slabs(seen, ids, np.sort(borders + rng.normal(0, 0.04, 6))),
            np.array(list(claims)),
            rng.choice([0.2, 0.5, 0.9], len(claims)),
            tuple(claims.values()),
        ),
        rng,
    )


def _slabs(points: np.ndarray, ids: np.ndarray, borders: np.ndarray) -> np.ndarray:
    return ids[np.searchsorted(borders, points[:, 0])].astype(np.int32)


def clear(points: np.ndarray, targets: np.ndarray) -> bool:
    """Return True if rounding changes neither the nearest points nor whether they are within the distance limit."""
    distances = np.sort(np.linalg.norm(points[None].astype(np.float64) - targets[:, None], axis=2), axis=1)
    return bool(
        (distances[:, 1] - distances[:, 0] > CLEAR).all() and (np.abs(distances[:, 0] - MAX_DISTANCE) > CLEAR).all()
    )


def is_clear(drawn: Drawn) -> bool:
    points, true_points = drawn.predictions.points_world, drawn.truth.points_world
    return clear(points, true_points) and clear(true_points, points)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_match_slow_reference(transfer: Transfer, drawn: Drawn) -> None:
    assume(is_clear(drawn))
    fast = drawn.evaluate(transfer).metrics()
    slow = slow_metrics(drawn.predictions, drawn.truth, transfer, MAX_DISTANCE, MIN_POINTS)
    assert fast == pytest.approx(slow, abs=1e-12)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_are_invariant_to_input_order(transfer: Transfer, drawn: Drawn) -> None:
    truth, predictions, rng = drawn.truth, drawn.predictions, drawn.rng
    p, v, t = (rng.permutation(len(x)) for x in (predictions.ids, predictions.points_world, truth.points_world))
    shuffled = PredictedInstances(
        predictions.points_world[v],
        predictions.instance_ids[v],
        predictions.ids[p],
        predictions.confidences[p],
        tuple(predictions.class_names[k] for k in p),
    )
    mixed = replace(truth, points_world=truth.points_world[t], instance_ids=truth.instance_ids[t])
    assert Drawn(mixed, shuffled, rng).evaluate(transfer) == drawn.evaluate(transfer)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_are_invariant_to_id_values(transfer: Transfer, drawn: Drawn) -> None:
    """The new ids have the same order, because ties are ranked by id."""
    truth, predictions = drawn.truth, drawn.predictions
    renamed = replace(predictions, ids=predictions.ids**2 + 6, instance_ids=_renamed(predictions.instance_ids))
    true_names = {k**2 + 6: name for k, name in truth.class_names.items()}
    other = Drawn(replace(truth, instance_ids=_renamed(truth.instance_ids), class_names=true_names), renamed, drawn.rng)
    assert other.evaluate(transfer).metrics() == drawn.evaluate(transfer).metrics()


def _renamed(ids: np.ndarray) -> np.ndarray:
    return np.where(ids > 0, ids**2 + 6, 0).astype(np.int32)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_are_invariant_to_rigid_motion(transfer: Transfer, drawn: Drawn) -> None:
    assume(is_clear(drawn))
    R, t = Rotation.random(random_state=drawn.rng).as_matrix(), drawn.rng.uniform(-3, 3, 3)
    moved = Drawn(
        replace(drawn.truth, points_world=(drawn.truth.points_world @ R.T + t).astype(np.float32)),
        replace(drawn.predictions, points_world=(drawn.predictions.points_world @ R.T + t).astype(np.float32)),
        drawn.rng,
    )
    assert moved.evaluate(transfer) == drawn.evaluate(transfer)


@examples
@given(drawn=scenes())
def test_instance_metrics_are_invariant_to_source_density(drawn: Drawn) -> None:
    """Duplicates of some map points have no effect. Duplicates of all true points change no ratio."""
    truth, predictions = drawn.truth, drawn.predictions
    again = drawn.rng.choice(len(predictions.points_world), 60)
    denser_map = replace(
        predictions,
        points_world=np.concatenate([predictions.points_world, predictions.points_world[again]]),
        instance_ids=np.concatenate([predictions.instance_ids, predictions.instance_ids[again]]),
    )
    expected = drawn.evaluate(Transfer.TO_TRUTH)
    assert Drawn(truth, denser_map, drawn.rng).evaluate(Transfer.TO_TRUTH) == expected
    twice = replace(
        truth,
        points_world=np.repeat(truth.points_world, 2, axis=0),
        instance_ids=np.repeat(truth.instance_ids, 2),
    )
    assert Drawn(twice, predictions, drawn.rng).evaluate(Transfer.TO_TRUTH, 2 * MIN_POINTS) == expected
    assert Drawn(twice, predictions, drawn.rng).evaluate(Transfer.TO_MAP, 2 * MIN_POINTS) == drawn.evaluate(
        Transfer.TO_MAP
    )


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes(), confidence=st.sampled_from([0.0, 0.3, 1.0]))
def test_instance_metrics_do_not_increase_with_false_positive(
    transfer: Transfer, drawn: Drawn, confidence: float
) -> None:
    predictions = drawn.predictions
    one_more = replace(
        predictions,
        ids=np.append(predictions.ids, 99),
        confidences=np.append(predictions.confidences, confidence),
        class_names=(*predictions.class_names, "chair"),
    )
    before = drawn.evaluate(transfer).metrics()
    after = Drawn(drawn.truth, one_more, drawn.rng).evaluate(transfer).metrics()
    for name, value in before.items():
        assert after[name] <= value, name
        if confidence == 0.0 and name.startswith("instances.ap"):
            assert after[name] == value, name


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_are_within_bounds(transfer: Transfer, drawn: Drawn) -> None:
    metrics = drawn.evaluate(transfer).metrics()
    for name, value in metrics.items():
        assert value >= 0
        assert value <= 1 or "_count" in name
    if metrics:
        by_class = [value for name, value in metrics.items() if name.startswith("instances.true_count.")]
        assert sum(by_class) == metrics["instances.true_count"]
        precision, recall = metrics["instances.precision50"], metrics["instances.recall50"]
        assert metrics["instances.f1_50"] * (precision + recall) == pytest.approx(2 * precision * recall)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes(unknown=False))
def test_instance_ap_decreases_with_threshold_if_all_are_known(transfer: Transfer, drawn: Drawn) -> None:
    """With ignored instances, a match at a low threshold could replace another match."""
    found = drawn.evaluate(transfer, min_points=1)
    agnostic = [found.agnostic[threshold].ap for threshold in (0.25, *IOU_THRESHOLDS)]
    by_class = [found.ap(threshold) for threshold in (0.25, *IOU_THRESHOLDS)]
    assert agnostic == sorted(agnostic, reverse=True)
    assert by_class == sorted(by_class, reverse=True)


@pytest.mark.parametrize("transfer", Transfer)
@examples
@given(drawn=scenes())
def test_instance_metrics_of_ground_truth_are_one(transfer: Transfer, drawn: Drawn) -> None:
    """Some instances are ignored, and the map is denser than the ground truth."""
    truth, rng = drawn.truth, drawn.rng
    ids = np.unique(truth.instance_ids[truth.instance_ids > 0])
    again = rng.choice(len(truth.points_world), 60)
    itself = PredictedInstances(
        np.concatenate([truth.points_world, truth.points_world[again]]),
        np.concatenate([truth.instance_ids, truth.instance_ids[again]]),
        ids.astype(np.int64),
        rng.uniform(size=len(ids)),
        tuple(truth.class_names[int(k)] or "tv" for k in ids),
    )
    metrics = Drawn(truth, itself, rng).evaluate(transfer).metrics()
    counts = {name for name in metrics if "_count" in name}
    assert all(metrics[name] == 1.0 for name in metrics.keys() - counts), metrics
    if metrics:
        assert metrics["instances.true_count"] + metrics["instances.ignored_count"] == len(ids)
