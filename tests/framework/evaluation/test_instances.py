"""Instance AP on cases small enough to compute by hand, and its invariances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.data import SceneTruth
from framework.errors import DataError
from framework.evaluation.instances import PredictedInstances, Transfer, average_precision, evaluate

SPACING = 0.2  # m between the points of a scene: more than twice the transfer distance, so points never mix


def line(count: int, offset: float = 0.0) -> np.ndarray:
    """(count, 3) points along x."""
    points = np.zeros((count, 3), np.float32)
    points[:, 0] = SPACING * np.arange(count)
    points[:, 1] = offset
    return points


def scene(runs: Sequence[tuple[int, int]], class_names: Mapping[int, str | None]) -> SceneTruth:
    """Points on a line, labelled by runs of (instance id, points)."""
    ids = np.repeat([k for k, _ in runs], [n for _, n in runs]).astype(np.int32)
    return SceneTruth(line(len(ids)), ids, class_names)


def prediction(
    truth: SceneTruth, runs: Sequence[tuple[int, int]], claims: Mapping[int, tuple[str, float]]
) -> PredictedInstances:
    """The truth's points labelled anew; `claims` give class and confidence of each predicted id."""
    ids = np.repeat([k for k, _ in runs], [n for _, n in runs]).astype(np.int32)
    return PredictedInstances(
        truth.points_world[: len(ids)],
        ids,
        np.array(list(claims), np.int64),
        np.array([confidence for _, confidence in claims.values()]),
        tuple(name for name, _ in claims.values()),
    )


def test_perfect_map():
    truth = scene([(0, 50), (1, 100), (2, 200)], {1: "chair", 2: "bed"})
    metrics = evaluate(
        prediction(truth, [(0, 50), (7, 100), (4, 200)], {7: ("chair", 0.5), 4: ("bed", 0.9)}), truth
    ).metrics()
    ones = ("ap50", "ap25", "ap", "ap50_agnostic", "mean_iou", "precision50", "recall50", "f1_50", "pq50")
    for name in (*ones, "ap50.chair", "ap50.bed"):
        assert metrics[f"instances.{name}"] == 1.0, name
    assert metrics["instances.true_count"] == 2


def test_iou_counts_points_outside_of_the_truth():
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    half = evaluate(prediction(truth, [(5, 200)], {5: ("chair", 1.0)}), truth)
    assert half.best_ious == {1: 0.5}
    assert half.best_ids == {1: 5}
    assert half.by_class[0.5]["chair"].ap == 1.0, "IoU equal to the threshold is a match"
    assert half.by_class[0.55]["chair"].ap == 0.0
    assert half.metrics()["instances.ap"] == pytest.approx(0.1)


def test_ap_by_hand():
    """Ranked hits 1 0 1 1 0 of 5 truths: precision 1, 1/2, 2/3, 3/4, 3/5; envelope at the hits 1, 3/4, 3/4."""
    assert average_precision(np.array([1, 0, 1, 1, 0], bool), 5) == pytest.approx((1 + 0.75 + 0.75) / 5)
    assert average_precision(np.zeros(0, bool), 3) == 0.0
    with pytest.raises(ValueError, match="without a true instance"):
        average_precision(np.zeros(0, bool), 0)


def test_false_positive_ranked_first_costs_precision():
    truth = scene([(1, 100), (2, 100), (0, 100)], {1: "chair", 2: "chair"})
    runs = [(11, 100), (12, 100), (13, 100)]
    first = evaluate(
        prediction(truth, runs, {11: ("chair", 0.8), 12: ("chair", 0.7), 13: ("chair", 0.9)}), truth
    ).metrics()
    last = evaluate(
        prediction(truth, runs, {11: ("chair", 0.8), 12: ("chair", 0.7), 13: ("chair", 0.1)}), truth
    ).metrics()
    assert first["instances.ap50"] == pytest.approx(2 / 3)
    assert last["instances.ap50"] == 1.0
    assert first["instances.precision50"] == last["instances.precision50"] == pytest.approx(2 / 3)
    assert first["instances.pq50"] == pytest.approx(2 / 2.5)


def test_each_truth_once():
    """A truth split in two equal halves: both reach IoU 0.5, the second one is a false positive."""
    truth = scene([(1, 100)], {1: "chair"})
    result = evaluate(prediction(truth, [(5, 50), (6, 50)], {5: ("chair", 0.5), 6: ("chair", 0.6)}), truth)
    score = result.by_class[0.5]["chair"]
    assert (score.true_positives, score.false_positives, score.ap) == (1, 1, 1.0)
    assert result.best_ids == {1: 6}, "of equal overlaps the more confident one"


def test_class_must_agree_except_in_the_agnostic_score():
    truth = scene([(1, 100), (2, 100)], {1: "chair", 2: "bed"})
    result = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("bed", 0.9), 6: ("bed", 0.8)}), truth)
    assert result.by_class[0.5]["chair"].ap == 0.0
    assert result.by_class[0.5]["bed"].ap == pytest.approx(0.5), "the chair called a bed comes first"
    assert result.ap(0.5) == pytest.approx(0.25)
    assert result.agnostic[0.5].ap == 1.0
    assert result.metrics()["instances.mean_iou"] == 1.0
    assert "instances.ap50.table" not in result.metrics()


def test_a_class_that_is_not_in_the_scene_costs_precision_but_has_no_ap():
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    metrics = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("chair", 0.9), 6: ("tv", 1.0)}), truth).metrics()
    assert metrics["instances.ap50"] == 1.0
    assert metrics["instances.precision50"] == 0.5
    assert metrics["instances.ap50_agnostic"] == 0.5


@pytest.mark.parametrize(
    ("class_name", "points"), [(None, 150), ("chair", 99)], ids=["class not known", "under 100 points"]
)
def test_match_with_an_ignored_instance_is_neither_right_nor_wrong(class_name, points):
    truth = scene([(1, 100), (2, points)], {1: "chair", 2: class_name})
    metrics = evaluate(
        prediction(truth, [(5, 100), (6, points)], {5: ("chair", 0.5), 6: ("chair", 0.9)}), truth
    ).metrics()
    assert metrics["instances.ap50"] == metrics["instances.precision50"] == metrics["instances.ap50_agnostic"] == 1.0
    assert metrics["instances.ignored_count"] == 1
    assert metrics["instances.true_count"] == 1


def test_a_prediction_mostly_on_unknown_instances_is_ignored():
    """It covers several unknown instances, none of them well: IoU 0.2 with each, yet all of it is unknown."""
    runs = [(1, 100)] + [(k, 120) for k in range(2, 8)]
    truth = scene(runs, {1: "chair"} | dict.fromkeys(range(2, 8)))
    covered = prediction(truth, [(5, 100), (6, 720)], {5: ("chair", 0.5), 6: ("chair", 0.9)})
    assert evaluate(covered, truth).overall.ignored == 1
    known = replace(truth, instance_ids=np.where(truth.instance_ids >= 5, 0, truth.instance_ids).astype(np.int32))
    score = evaluate(covered, known).overall
    assert (score.ignored, score.false_positives) == (0, 1), "exactly half of it is unknown: wrong"


def test_an_evaluated_match_is_never_ignored():
    """At IoU 0.25 the prediction finds its truth although more of it lies on an unknown instance."""
    truth = scene([(1, 100), (2, 150)], {1: "chair", 2: None})
    result = evaluate(prediction(truth, [(5, 250)], {5: ("chair", 0.5)}), truth)
    assert result.by_class[0.25]["chair"].ap == 1.0
    assert result.by_class[0.5]["chair"].ignored == 1


def test_predictions_without_points_or_far_from_the_truth_are_wrong():
    truth = scene([(1, 100)], {1: "chair"})
    claims = {5: ("chair", 0.5), 6: ("chair", 0.9), 7: ("chair", 0.8)}
    near = prediction(truth, [(5, 100)], claims)
    far = replace(
        near,
        points_world=np.concatenate([near.points_world, line(30, offset=1.0)]),
        instance_ids=np.concatenate([near.instance_ids, np.full(30, 6, np.int32)]),
    )
    assert evaluate(far, truth).overall.false_positives == 2
    assert evaluate(far, truth).ap(0.5) == pytest.approx(1 / 3)


@pytest.mark.parametrize(("distance", "iou"), [(0.049, 1.0), (0.051, 0.0)])
def test_labels_are_carried_within_5_cm(distance, iou):
    truth = scene([(1, 100)], {1: "chair"})
    moved = prediction(truth, [(5, 100)], {5: ("chair", 1.0)})
    moved = replace(moved, points_world=moved.points_world + np.float32([0, distance, 0]))
    assert evaluate(moved, truth).best_ious == {1: iou}


def test_a_nearer_vertex_of_no_instance_wins():
    truth = scene([(1, 100)], {1: "chair"})
    labelled = prediction(truth, [(5, 100)], {5: ("chair", 1.0)})
    with_background = replace(
        labelled,
        points_world=np.concatenate([labelled.points_world + np.float32([0, 0.03, 0]), truth.points_world[:40]]),
        instance_ids=np.concatenate([labelled.instance_ids, np.zeros(40, np.int32)]),
    )
    assert evaluate(with_background, truth).best_ious == {1: 0.6}


def test_transfer_to_the_map_counts_map_vertices():
    """Ten points of background are under the instance, and the map has two vertices at each of them."""
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    dense = prediction(truth, [(5, 110)], {5: ("chair", 1.0)})
    twice = replace(
        dense,
        points_world=np.concatenate([dense.points_world, dense.points_world[100:] + np.float32([0, 0.01, 0])]),
        instance_ids=np.concatenate([dense.instance_ids, np.full(10, 5, np.int32)]),
    )
    assert evaluate(twice, truth).best_ious[1] == pytest.approx(100 / 110)
    assert evaluate(twice, truth, transfer=Transfer.TO_MAP).best_ious[1] == pytest.approx(100 / 120)


def test_empty_map_and_empty_truth():
    truth = scene([(1, 100)], {1: "chair"})
    empty = PredictedInstances(
        np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0), ()
    )
    metrics = evaluate(empty, truth).metrics()
    assert metrics["instances.ap50"] == metrics["instances.mean_iou"] == metrics["instances.precision50"] == 0.0
    nothing = SceneTruth(np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    assert evaluate(empty, nothing).metrics() == {}
    assert evaluate(prediction(truth, [(5, 100)], {5: ("chair", 1.0)}), nothing).metrics() == {}
    assert evaluate(empty, truth, transfer=Transfer.TO_MAP).metrics()["instances.ap50"] == 0.0


def test_inconsistent_predictions_are_refused():
    truth = scene([(1, 100)], {1: "chair"})
    with pytest.raises(DataError, match="labelled 6"):
        prediction(truth, [(6, 10)], {5: ("chair", 1.0)})
    with pytest.raises(DataError, match="not finite"):
        prediction(truth, [(5, 10)], {5: ("chair", float("nan"))})


@st.composite
def scenes(draw):
    """A truth of runs over 600 points and a prediction with its own borders; some classes are not known."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def labels(ids):
        borders = np.sort(rng.integers(0, 600, 5))
        return np.repeat(rng.permutation(ids), np.diff([0, *borders, 600])).astype(np.int32)

    truth = SceneTruth(line(600), labels(np.arange(6)), {k: [None, "chair", "bed"][k % 3] for k in range(1, 6)})
    predicted = PredictedInstances(
        truth.points_world,
        labels(np.array([0, 3, 8, 9, 12, 13])),
        np.array([3, 8, 9, 12, 13]),
        rng.choice([0.2, 0.5, 0.9], 5),
        tuple(rng.choice(["chair", "bed", "tv"], 5)),
    )
    return truth, predicted, rng


@settings(deadline=None, max_examples=40)
@given(scenes())
def test_invariant_to_the_order_of_predictions_and_of_points(drawn):
    truth, predicted, rng = drawn
    before = evaluate(predicted, truth)
    p, v, t = rng.permutation(5), rng.permutation(600), rng.permutation(600)
    shuffled = PredictedInstances(
        predicted.points_world[v],
        predicted.instance_ids[v],
        predicted.ids[p],
        predicted.confidences[p],
        tuple(predicted.class_names[k] for k in p),
    )
    after = evaluate(shuffled, replace(truth, points_world=truth.points_world[t], instance_ids=truth.instance_ids[t]))
    assert after == before


@settings(deadline=None, max_examples=40)
@given(scenes())
def test_bounds_and_slow_reference(drawn):
    """Overlaps as sets of points give the same best IoUs; scores stay in [0, 1]."""
    truth, predicted, _ = drawn
    result = evaluate(predicted, truth)
    for k, iou in result.best_ious.items():
        true_points = set(np.flatnonzero(truth.instance_ids == k))
        predicted_points = [set(np.flatnonzero(predicted.instance_ids == j)) for j in predicted.ids]
        assert iou == max(len(true_points & points) / len(true_points | points) for points in predicted_points)
    for name, value in result.metrics().items():
        assert value >= 0
        assert value <= 1 or name.endswith("_count")


def test_equally_near_vertices_give_the_same_label_in_any_order():
    """Each true point lies exactly between two map vertices of different instances."""
    truth = scene([(1, 100)], {1: "chair"})
    up = np.float32([0, 0.03125, 0])
    both = PredictedInstances(
        np.concatenate([truth.points_world + up, truth.points_world - up]),
        np.repeat([4, 5], 100).astype(np.int32),
        np.array([4, 5]),
        np.array([0.5, 0.5]),
        ("chair", "chair"),
    )
    results = set()
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(200)
        shuffled = replace(both, points_world=both.points_world[order], instance_ids=both.instance_ids[order])
        results.add(tuple(evaluate(shuffled, truth).metrics().items()))
    assert len(results) == 1


def test_a_loose_match_with_an_unknown_instance_is_ignored_although_most_of_it_lies_elsewhere():
    """40 of its 100 points on an unknown instance of 40: IoU 0.4, enough at 0.25 and not at 0.5."""
    truth = scene([(1, 100), (2, 40), (0, 60)], {1: "chair", 2: None})
    result = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("chair", 0.5), 6: ("chair", 0.9)}), truth)
    assert result.by_class[0.25]["chair"].ignored == 1
    assert result.by_class[0.5]["chair"].false_positives == 1
