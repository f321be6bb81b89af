"""Tests for instance AP, compared with manual results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from framework.data import SceneTruth
from framework.errors import DataError
from framework.evaluation.instances import Outcome, PredictedInstances, Transfer, average_precision, evaluate, judge

SPACING = 0.2  # m, between points; more than twice the transfer distance, so that labels do not mix


def line(count: int, offset: float = 0.0) -> np.ndarray:
    """Return points (count, 3), m, on a line along x."""
    points = np.zeros((count, 3), np.float32)
    points[:, 0] = SPACING * np.arange(count)
    points[:, 1] = offset
    return points


def scene(runs: Sequence[tuple[int, int]], class_names: Mapping[int, str | None]) -> SceneTruth:
    """Return points on a line. `runs` are pairs of an instance id and a number of points."""
    ids = np.repeat([k for k, _ in runs], [n for _, n in runs]).astype(np.int32)
    return SceneTruth(line(len(ids)), ids, class_names)


def prediction(
    truth: SceneTruth, runs: Sequence[tuple[int, int]], claims: Mapping[int, tuple[str, float]]
) -> PredictedInstances:
    """Return the true points with other labels. `claims` are the class and the confidence of each predicted id."""
    ids = np.repeat([k for k, _ in runs], [n for _, n in runs]).astype(np.int32)
    return PredictedInstances(
        truth.points_world[: len(ids)],
        ids,
        np.array(list(claims), np.int64),
        np.array([confidence for _, confidence in claims.values()]),
        tuple(name for name, _ in claims.values()),
    )


def test_evaluate_perfect_map_has_all_scores_one():
    truth = scene([(0, 50), (1, 100), (2, 200)], {1: "chair", 2: "bed"})
    metrics = evaluate(
        prediction(truth, [(0, 50), (7, 100), (4, 200)], {7: ("chair", 0.5), 4: ("bed", 0.9)}), truth
    ).metrics()
    ones = ("ap50", "ap25", "ap", "ap50_agnostic", "mean_iou", "precision50", "recall50", "f1_50", "pq50")
    for name in (*ones, "ap50.chair", "ap50.bed"):
        assert metrics[f"instances.{name}"] == 1.0, name
    assert metrics["instances.true_count"] == 2


def test_iou_counts_points_outside_true_instance():
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    half = evaluate(prediction(truth, [(5, 200)], {5: ("chair", 1.0)}), truth)
    assert half.best_ious == {1: 0.5}
    assert half.best_ids == {1: 5}
    assert half.by_class[0.5]["chair"].ap == 1.0, "expected a match at an IoU equal to the threshold"
    assert half.by_class[0.55]["chair"].ap == 0.0
    assert half.metrics()["instances.ap"] == pytest.approx(0.1)


def test_average_precision_matches_manual_result():
    """The precision is 1, 1/2, 2/3, 3/4, 3/5 and its envelope at the three matches is 1, 3/4, 3/4."""
    assert average_precision(np.array([1, 0, 1, 1, 0], bool), 5) == pytest.approx((1 + 0.75 + 0.75) / 5)
    assert average_precision(np.zeros(0, bool), 3) == 0.0
    with pytest.raises(ValueError, match="average precision: expected at least one ground-truth instance, got none"):
        average_precision(np.zeros(0, bool), 0)


def test_ap_decreases_with_false_positive_ranked_first():
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


def test_evaluate_matches_each_true_instance_once():
    """The two halves of a true instance have IoU 0.5. Only one of them is matched."""
    truth = scene([(1, 100)], {1: "chair"})
    result = evaluate(prediction(truth, [(5, 50), (6, 50)], {5: ("chair", 0.5), 6: ("chair", 0.6)}), truth)
    score = result.by_class[0.5]["chair"]
    assert (score.true_positives, score.false_positives, score.ap) == (1, 1, 1.0)
    assert result.best_ids == {1: 6}, "expected the more confident one of equal overlaps"


def test_ap_requires_class_match_except_agnostic_ap():
    truth = scene([(1, 100), (2, 100)], {1: "chair", 2: "bed"})
    result = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("bed", 0.9), 6: ("bed", 0.8)}), truth)
    assert result.by_class[0.5]["chair"].ap == 0.0
    assert result.by_class[0.5]["bed"].ap == pytest.approx(0.5), "expected the chair predicted as a bed to rank first"
    assert result.ap(0.5) == pytest.approx(0.25)
    assert result.agnostic[0.5].ap == 1.0
    assert result.metrics()["instances.mean_iou"] == 1.0
    assert "instances.ap50.table" not in result.metrics()


def test_evaluate_absent_class_lowers_precision_without_ap():
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    metrics = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("chair", 0.9), 6: ("tv", 1.0)}), truth).metrics()
    assert metrics["instances.ap50"] == 1.0
    assert metrics["instances.precision50"] == 0.5
    assert metrics["instances.ap50_agnostic"] == 0.5


@pytest.mark.parametrize(
    ("class_name", "points"), [(None, 150), ("chair", 99)], ids=["class not known", "under 100 points"]
)
def test_evaluate_does_not_count_match_with_ignored_instance(class_name, points):
    truth = scene([(1, 100), (2, points)], {1: "chair", 2: class_name})
    metrics = evaluate(
        prediction(truth, [(5, 100), (6, points)], {5: ("chair", 0.5), 6: ("chair", 0.9)}), truth
    ).metrics()
    assert metrics["instances.ap50"] == metrics["instances.precision50"] == metrics["instances.ap50_agnostic"] == 1.0
    assert metrics["instances.ignored_count"] == 1
    assert metrics["instances.true_count"] == 1


def test_evaluate_ignores_prediction_on_unknown_instances():
    """The prediction covers six unknown instances completely. The IoU with each is 1/6."""
    runs = [(1, 100)] + [(k, 120) for k in range(2, 8)]
    truth = scene(runs, {1: "chair"} | dict.fromkeys(range(2, 8)))
    covered = prediction(truth, [(5, 100), (6, 720)], {5: ("chair", 0.5), 6: ("chair", 0.9)})
    assert evaluate(covered, truth).overall.ignored == 1
    known = replace(truth, instance_ids=np.where(truth.instance_ids >= 5, 0, truth.instance_ids).astype(np.int32))
    score = evaluate(covered, known).overall
    assert (score.ignored, score.false_positives) == (0, 1), "expected a false positive if exactly half is unknown"


def test_evaluate_ignores_prediction_of_unannotated_class():
    """The annotation has chairs and beds, but no keyboards."""
    truth = replace(scene([(1, 100), (0, 300)], {1: "chair"}), classes=("chair", "bed"))
    found = [(1, 100), (2, 100), (0, 100), (3, 100)]
    claims = {1: ("chair", 0.8), 2: ("keyboard", 0.9), 3: ("bed", 0.7)}
    result = evaluate(prediction(truth, found, claims), truth)
    assert (result.overall.true_positives, result.overall.false_positives, result.overall.ignored) == (1, 1, 1)
    assert result.metrics()["instances.ap50_agnostic"] == 1.0
    assert evaluate(prediction(truth, found, claims), replace(truth, classes=None)).overall.false_positives == 2
    called_otherwise = evaluate(prediction(truth, [(1, 100)], {1: ("bench", 0.8)}), truth)
    assert called_otherwise.metrics()["instances.ap50_agnostic"] == 1.0, (
        "expected a class-agnostic match with any class"
    )


def test_evaluate_keeps_prediction_with_evaluated_match():
    """The prediction matches the chair at IoU 0.25, although it covers more of an unknown instance."""
    truth = scene([(1, 100), (2, 150)], {1: "chair", 2: None})
    result = evaluate(prediction(truth, [(5, 250)], {5: ("chair", 0.5)}), truth)
    assert result.by_class[0.25]["chair"].ap == 1.0
    assert result.by_class[0.5]["chair"].ignored == 1


def test_evaluate_distant_prediction_is_false_positive():
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
def test_label_transfer_is_limited_to_5_cm(distance, iou):
    truth = scene([(1, 100)], {1: "chair"})
    moved = prediction(truth, [(5, 100)], {5: ("chair", 1.0)})
    moved = replace(moved, points_world=moved.points_world + np.float32([0, distance, 0]))
    assert evaluate(moved, truth).best_ious == {1: iou}


def test_label_transfer_uses_nearest_background_vertex():
    truth = scene([(1, 100)], {1: "chair"})
    labeled = prediction(truth, [(5, 100)], {5: ("chair", 1.0)})
    with_background = replace(
        labeled,
        points_world=np.concatenate([labeled.points_world + np.float32([0, 0.03, 0]), truth.points_world[:40]]),
        instance_ids=np.concatenate([labeled.instance_ids, np.zeros(40, np.int32)]),
    )
    assert evaluate(with_background, truth).best_ious == {1: 0.6}


def test_label_transfer_to_map_counts_map_vertices():
    """The prediction covers ten background points, at which the map has two vertices each."""
    truth = scene([(1, 100), (0, 100)], {1: "chair"})
    dense = prediction(truth, [(5, 110)], {5: ("chair", 1.0)})
    twice = replace(
        dense,
        points_world=np.concatenate([dense.points_world, dense.points_world[100:] + np.float32([0, 0.01, 0])]),
        instance_ids=np.concatenate([dense.instance_ids, np.full(10, 5, np.int32)]),
    )
    assert evaluate(twice, truth).best_ious[1] == pytest.approx(100 / 110)
    assert evaluate(twice, truth, transfer=Transfer.TO_MAP).best_ious[1] == pytest.approx(100 / 120)


EMPTY_MAP = PredictedInstances(
    np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0), ()
)


def test_evaluate_empty_map_has_zero_scores():
    truth = scene([(1, 100)], {1: "chair"})
    metrics = evaluate(EMPTY_MAP, truth).metrics()
    assert metrics["instances.ap50"] == metrics["instances.mean_iou"] == metrics["instances.precision50"] == 0.0
    assert evaluate(EMPTY_MAP, truth, transfer=Transfer.TO_MAP).metrics()["instances.ap50"] == 0.0


def test_evaluate_empty_truth_has_no_metrics():
    truth = scene([(1, 100)], {1: "chair"})
    nothing = SceneTruth(np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    assert evaluate(EMPTY_MAP, nothing).metrics() == {}
    assert evaluate(prediction(truth, [(5, 100)], {5: ("chair", 1.0)}), nothing).metrics() == {}


def test_evaluate_inconsistent_predictions_raise():
    truth = scene([(1, 100)], {1: "chair"})
    with pytest.raises(DataError, match="expected 0 or a value of `ids`, got 6"):
        prediction(truth, [(6, 10)], {5: ("chair", 1.0)})
    with pytest.raises(DataError, match="expected finite values"):
        prediction(truth, [(5, 10)], {5: ("chair", float("nan"))})


def test_label_transfer_tie_is_independent_of_order():
    """Each true point is midway between two map vertices of different instances."""
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


def test_evaluate_ignores_unknown_match_only_above_threshold():
    """The IoU with the unknown instance is 0.4, i.e. a match at 0.25 but not at 0.5."""
    truth = scene([(1, 100), (2, 40), (0, 60)], {1: "chair", 2: None})
    result = evaluate(prediction(truth, [(5, 100), (6, 100)], {5: ("chair", 0.5), 6: ("chair", 0.9)}), truth)
    assert result.by_class[0.25]["chair"].ignored == 1
    assert result.by_class[0.5]["chair"].false_positives == 1


def test_evaluate_three_predictions_match_manual_result():
    """Three predictions with equal confidences are ranked by id.

    Predictions 11 and 12 cover 70 and 50 of the 120 points of one chair, and 13 covers the other chair. At IoU 0.5, 11
    and 13 are correct. The precision is 1, 1/2, 2/3, so that AP = (1 + 2/3) / 2 = 5/6. F1 = 4/5, and PQ = (7/12 + 1) /
    2.5 = 19/30. From 0.6 on, only 13 is correct and AP = 1/6. The mean AP is (2 * 5/6 + 8 * 1/6) / 10 = 3/10. At 0.25,
    12 is a duplicate of 11.
    """
    truth = scene([(1, 120), (2, 100)], {1: "chair", 2: "chair"})
    claims = {11: ("chair", 0.9), 12: ("chair", 0.9), 13: ("chair", 0.9)}
    metrics = evaluate(prediction(truth, [(11, 70), (12, 50), (13, 100)], claims), truth).metrics()
    expected = {"ap50": 5 / 6, "ap25": 5 / 6, "ap": 0.3, "ap50_agnostic": 5 / 6, "mean_iou": 19 / 24}
    expected |= {"precision50": 2 / 3, "recall50": 1, "f1_50": 4 / 5, "pq50": 19 / 30}
    for name, value in expected.items():
        assert metrics[f"instances.{name}"] == pytest.approx(value), name


def test_evaluate_likely_metrics_ignore_unlikely():
    """Of three predictions, 11 (correct) and 12 (duplicate) are likely, and 13 (correct) is not."""
    truth = scene([(1, 120), (2, 100)], {1: "chair", 2: "chair"})
    claims = {11: ("chair", 0.9), 12: ("chair", 0.9), 13: ("chair", 0.9)}
    predicted = prediction(truth, [(11, 70), (12, 50), (13, 100)], claims)
    assert "instances.likely.f1_50" not in evaluate(predicted, truth).metrics()
    known = {11: (0.5, 0.9), 12: (0.8, 0.9), 13: (0.49, 0.9)}
    metrics = evaluate(replace(predicted, probabilities=known), truth).metrics()
    for name in ("precision50", "recall50", "f1_50"):
        assert metrics[f"instances.likely.{name}"] == pytest.approx(1 / 2), name


def test_evaluate_ranks_equal_confidences_by_id():
    """Predictions 11 and 12 cover 50 and 70 of the 120 points of a chair.

    At IoU 0.5, 11 is wrong, and 12 and 13 are correct, so AP = 2/3. At 0.25, 11 matches the chair and AP = 5/6.
    """
    truth = scene([(1, 120), (2, 100)], {1: "chair", 2: "chair"})
    claims = {11: ("chair", 0.9), 12: ("chair", 0.9), 13: ("chair", 0.9)}
    result = evaluate(prediction(truth, [(12, 70), (11, 50), (13, 100)], claims), truth)
    assert result.ap(0.5) == pytest.approx(2 / 3)
    assert result.ap(0.25) == pytest.approx(5 / 6)


def test_evaluate_metrics_by_class_match_manual_result():
    """One of two chairs is found with IoU 3/4 and one is missed.

    A bed is found with IoU 3/5, but a false bed has a higher confidence. The table is missed.
    """
    truth = scene(
        [(1, 100), (2, 100), (3, 150), (4, 100), (0, 200)], {1: "chair", 2: "chair", 3: "bed", 4: "dining table"}
    )
    claims = {11: ("chair", 0.9), 12: ("bed", 0.4), 13: ("bed", 0.5), 14: ("tv", 0.1)}
    runs = [(11, 75), (0, 125), (12, 90), (0, 160), (13, 100), (14, 50), (0, 50)]
    metrics = evaluate(prediction(truth, runs, claims), truth).metrics()
    expected = {
        "ap50.chair": 1 / 2,
        "ap50.bed": 1 / 2,  # the second bed is correct: precision 1/2
        "ap50.dining table": 0,
        "ap50": 1 / 3,
        "ap25.chair": 1 / 2,
        "ap.chair": 6 / 10 * 1 / 2,  # correct at 0.5 to 0.75
        "ap.bed": 3 / 10 * 1 / 2,  # correct at 0.5 to 0.6
        "ap.dining table": 0,
        "ap": (3 / 10 + 3 / 20) / 3,
        "precision50": 2 / 4,
        "recall50": 2 / 4,
        "f1_50": 2 / 4,
        "pq50": (3 / 4 / 1.5 + 3 / 5 / 1.5 + 0) / 3,
        "ap50_agnostic": (1 + 2 / 3) / 4,  # ranks: correct chair, wrong bed, correct bed, wrong tv
        "mean_iou": (3 / 4 + 0 + 3 / 5 + 0) / 4,
        "true_count": 4,
        "true_count.chair": 2,
        "true_count.bed": 1,
        "true_count.dining table": 1,
        "ignored_count": 0,
    }
    for name, value in expected.items():
        assert metrics[f"instances.{name}"] == pytest.approx(value), name
    assert not [name for name in metrics if name.endswith(".tv")]


def test_label_transfers_differ_with_vertex_density():
    """The prediction covers 80 of 100 chair points and 20 wall points.

    The map has three vertices per chair point. The IoU is 80 / (100 + 20) = 2/3 on the true points, which is a match at
    4 of the 10 thresholds. The IoU is 240 / (300 + 20) = 3/4 on the map, a match at 6 of the 10 thresholds.
    """
    truth = scene([(0, 100), (1, 100)], {1: "chair"})
    once = prediction(truth, [(0, 80), (5, 100), (0, 20)], {5: ("chair", 1.0)})
    aside = [truth.points_world[100:] + np.float32([0, 0, z]) for z in (-0.01, 0.01)]
    dense = replace(
        once,
        points_world=np.concatenate([once.points_world, *aside]),
        instance_ids=np.concatenate([once.instance_ids, once.instance_ids[100:], once.instance_ids[100:]]),
    )
    to_truth = evaluate(dense, truth)
    to_map = evaluate(dense, truth, transfer=Transfer.TO_MAP)
    assert to_truth.best_ious == {1: 2 / 3}
    assert to_map.best_ious == {1: 3 / 4}
    assert to_truth.metrics()["instances.ap"] == pytest.approx(0.4)
    assert to_map.metrics()["instances.ap"] == pytest.approx(0.6)


@pytest.mark.parametrize("transfer", Transfer)
def test_label_transfer_distance_limit_is_inclusive(transfer):
    """The distance of 5/64 m is exact in floating point, because the offsets are 3/64 m and 4/64 m."""
    truth = scene([(1, 100)], {1: "chair"})
    moved = prediction(truth, [(5, 100)], {5: ("chair", 1.0)})
    moved = replace(moved, points_world=moved.points_world + np.float32([0, 3 / 64, 4 / 64]))
    at, below = 5 / 64, float(np.nextafter(5 / 64, 0))
    assert evaluate(moved, truth, transfer=transfer, max_distance=at).best_ious == {1: 1.0}
    assert evaluate(moved, truth, transfer=transfer, max_distance=below).best_ious == {1: 0.0}


def test_judge_outcomes_match_evaluation_counts():
    """Two predictions are on one chair. The others have a wrong class, an unknown instance or no instance."""
    names = {1: "chair", 2: "bed", 3: "chair", 4: None, 5: "book"}
    truth = scene([(1, 120), (2, 100), (3, 100), (4, 100), (5, 100), (0, 100)], names)
    runs = [(11, 80), (12, 40), (13, 100), (0, 100), (14, 100), (0, 100), (15, 100)]
    claims = {11: ("chair", 0.9), 12: ("chair", 0.8), 13: ("couch", 0.7), 14: ("chair", 0.6), 15: ("bed", 0.5)}
    predictions = prediction(truth, runs, claims)
    judged, missed = judge(predictions, truth)
    assert [(one.id, one.outcome, one.truth_id, one.truth_class) for one in judged] == [
        (11, Outcome.RIGHT, 1, "chair"),
        (12, Outcome.FALSE, 1, "chair"),
        (13, Outcome.WRONG_CLASS, 2, "bed"),
        (14, Outcome.IGNORED, 4, None),
        (15, Outcome.FALSE, 0, None),
    ]
    assert [one.iou for one in judged] == pytest.approx([80 / 120, 40 / 120, 1.0, 1.0, 0.0])
    assert missed == {2: "bed", 3: "chair", 5: "book"}
    overall = evaluate(predictions, truth).overall
    assert overall is not None
    counts = [sum(one.outcome is outcome for one in judged) for outcome in (Outcome.RIGHT, Outcome.IGNORED)]
    assert counts == [overall.true_positives, overall.ignored]
    assert overall.truths - overall.true_positives == len(missed)


def test_forecasts_match_objects_of_any_class():
    """Of four predictions, two match an object, one of them with its class, one is wrong and one is ignored."""
    truth = scene([(1, 100), (2, 100), (3, 100), (0, 100)], {1: "chair", 2: "bed", 3: None})
    claims = {11: ("chair", 0.9), 12: ("sofa", 0.8), 13: ("lamp", 0.7), 14: ("cup", 0.6)}
    predicted = prediction(truth, [(11, 100), (12, 100), (13, 100), (14, 100)], claims)
    assert evaluate(predicted, truth).forecasts == {}, "expected no forecasts without probabilities"
    probabilities = {11: (0.95, 0.5), 12: (0.85, 0.4), 13: (0.75, 0.3), 14: (0.65, 0.2)}
    found = evaluate(replace(predicted, probabilities=probabilities), truth)
    exists, right = found.forecasts["exists"], found.forecasts["class"]
    assert (exists.probabilities.tolist(), exists.outcomes.tolist()) == ([0.95, 0.85, 0.65], [True, True, False])
    assert (right.probabilities.tolist(), right.outcomes.tolist()) == ([0.5, 0.4], [True, False])
    metrics = found.metrics()
    assert metrics["instances.calibration_count.exists"] == 3
    assert metrics["instances.ece.exists"] == pytest.approx((0.05 + 0.15 + 0.65) / 3)
    assert metrics["instances.brier.class"] == pytest.approx((0.25 + 0.16) / 2)
    assert metrics["instances.auroc.exists"] == 1.0
