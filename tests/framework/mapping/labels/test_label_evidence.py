"""Tests for the compact Bayesian update of labels, compared with the complete recursions of the paper."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.mapping.labels.class_slots import ALL_NAMED, CLASS_SLOTS, NEW_CLASSES, NO_CLASS
from framework.mapping.labels.evidence_rows import INSTANCE_SLOTS
from framework.mapping.labels.label_evidence import MAX_CLUSTER_SCORE, MAX_SCORE, named_classes, pack_class_scores
from framework.mapping.labels.label_evidence_kernels import (
    Combine,
    add_evidence,
    best_class,
    best_counted_instance,
    best_instance,
    update_voxel,
)
from tests.support.one_pixel import BARE, COVERED, FLOOR, SCORE_SCALE, blank, distribution, measured, voted


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), labels=st.integers(1, INSTANCE_SLOTS))
def test_label_update_matches_full_recursion_if_labels_fit(seed: int, labels: int) -> None:
    """There are at most as many labels as slots. The posteriors are those of eqs. (7) and (8)."""
    rng = np.random.default_rng(seed)
    classes = labels  # all classes are named
    evidence = blank()
    instance_log = np.zeros(labels + 1)  # [0]: all other instances together
    class_log = np.zeros(classes)
    for _ in range(20):
        instance = int(rng.integers(1, labels + 1))
        score = float(rng.uniform(0.2, 1))
        p = distribution(rng, classes)
        evicted = update_voxel(evidence, 0, measured([instance], [score], p[None], 1.0, labels), COVERED)
        assert evicted == 0
        # P(O = instance) = score, P(O = any other) = FLOOR
        instance_log += np.log(FLOOR)
        instance_log[instance] += np.log(score / FLOOR)
        class_log += np.log(p)
    found = {int(i): float(v) for i, v in zip(evidence.instance_ids[0], evidence.instance_value[0], strict=True) if i}
    for i, log in found.items():
        assert abs(log - (instance_log[i] - instance_log[0])) < 1e-3
    assert best_instance(evidence, 0) == 1 + np.argmax(instance_log[1:])
    order = evidence.class_ids[0][: min(classes, CLASS_SLOTS)]
    ours = evidence.class_value[0][: len(order)] / SCORE_SCALE
    exact = class_log[order - 1]
    assert np.allclose(ours - ours[0], exact - exact[0], atol=2e-3)
    assert best_class(evidence, 0) == np.argmax(class_log)


def test_label_update_matches_full_recursion_for_80_classes() -> None:
    """There are more classes than slots, so labels are evicted. The best class is almost always correct."""
    rng = np.random.default_rng(0)
    agree = 0
    evictions = 0
    voxels = 300
    for _ in range(voxels):
        evidence = blank()
        log = np.zeros(80)
        true = int(rng.integers(80))
        for _ in range(12):
            logits = rng.normal(0, 1, 80)
            logits[true] += 2.5
            p = np.exp(logits) / np.exp(logits).sum()
            p = 0.9 * p + 0.1 / 80
            log += np.log(p)
            evictions += update_voxel(evidence, 0, measured([1], [0.9], p[None], 1.0, 1), COVERED)
        agree += best_class(evidence, 0) == np.argmax(log)
    assert agree >= 0.97 * voxels
    assert evictions > 0


def test_label_update_of_voxel_under_two_masks_applies_both() -> None:
    evidence = blank()
    p = np.full((2, 3), 1 / 3)
    update_voxel(evidence, 0, measured([1, 2], [0.9, 0.5], p, 1.0, 2), COVERED)
    found = dict(zip(evidence.instance_ids[0].tolist(), evidence.instance_value[0].tolist(), strict=True))
    assert found[1] == np.float32(np.log(0.9 / FLOOR))
    assert found[2] == np.float32(np.log(0.5 / FLOOR))


def test_label_update_absence_lowers_only_matched_instance() -> None:
    evidence = blank()
    one = np.full((1, 3), 1 / 3)
    update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), COVERED)
    before = float(evidence.instance_value[0, 0])
    update_voxel(evidence, 0, measured([2], [0.9], one, 0.5, 2), BARE)  # instance 2 is matched at other pixels
    assert float(evidence.instance_value[0, 0]) == before
    update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), BARE)  # instance 1 is matched at other pixels
    assert float(evidence.instance_value[0, 0]) == np.float32(before + np.log(0.5))
    for _ in range(10):
        update_voxel(evidence, 0, measured([1], [0.9], one, 0.5, 2), BARE)
    assert best_instance(evidence, 0) == 0, "expected no instance: unnamed instances are more likely"


def test_label_update_without_instance_adds_no_evidence() -> None:
    evidence = blank()
    update_voxel(evidence, 0, measured([0], [0.9], np.full((1, 3), 1 / 3), 0.5, 1), COVERED)
    assert (evidence.instance_ids == 0).all()
    assert (evidence.class_ids == NO_CLASS).all()


def test_named_classes_are_relative_to_mean_of_unnamed_classes() -> None:
    p = np.array([[0.5, 0.2, 0.1, 0.06, 0.04, 0.03, 0.025, 0.02, 0.01, 0.009, 0.006]])
    relative, named, bits = named_classes(np.log(p), logarithmic=True)
    assert named.tolist() == [list(range(1, NEW_CLASSES + 1))]
    assert bits[0].tolist() == [0, 1, 2, 4, 8, 16, 32, 64, 128, 0, 0, 0]
    rest = p[0, NEW_CLASSES:].mean()
    assert np.allclose(relative, np.log(p / rest), atol=1e-5)


def test_label_slots_replace_least_likely_label_if_full() -> None:
    labels, logs = np.arange(1, 5, dtype=np.int32), np.float32([4, 1, 2, 3])
    assert add_evidence(labels, logs, 0, np.int32(9), np.float32(0.5), Combine.SUM, np.float32(9)) == 1
    assert labels.tolist() == [1, 2, 3, 4], "expected no change: the new label is the least likely"
    assert add_evidence(labels, logs, 0, np.int32(9), np.float32(1.5), Combine.SUM, np.float32(9)) == 1
    assert dict(zip(labels.tolist(), logs.tolist(), strict=True)) == {1: 4, 9: 1.5, 3: 2, 4: 3}


def test_best_counted_instance_skips_uncounted_instances() -> None:
    evidence = blank()
    evidence.instance_ids[0], evidence.instance_value[0] = [1, 5, 3, 2], [9, 4, 7, -1]
    counts = np.ones(6, np.bool_)
    assert best_counted_instance(evidence, 0, counts) == 1
    counts[1] = False
    assert best_counted_instance(evidence, 0, counts) == 3
    counts[[3, 5]] = False
    assert best_counted_instance(evidence, 0, counts) == 0, (
        "expected no instance: unnamed instances are more likely than 2"
    )


SEEN = [([1], [0.9], [2]), ([2], [0.4], [3]), ([2], [0.5], [3]), ([3], [0.6], [2])]
"""Observations of a voxel in four frames: instances, scores and classes."""


@pytest.mark.parametrize(
    ("combine", "weighed", "instance", "label"),
    [
        (Combine.SUM, False, 2, 2),  # instance 2 has the most counts; classes 2 and 3 tie, and the smaller id is used
        (Combine.LARGEST, True, 1, 2),
        (Combine.LATEST, False, 3, 2),
    ],
)
def test_combine_rules_select_expected_labels(combine: Combine, weighed: bool, instance: int, label: int) -> None:
    evidence = blank()
    for ids, scores, classes in SEEN:
        update_voxel(evidence, 0, voted(ids, scores if weighed else [1.0], classes, combine), COVERED)
    assert best_instance(evidence, 0) == instance
    assert best_class(evidence, 0) == label


def test_latest_rule_uses_last_cluster_at_pixel() -> None:
    evidence = blank()
    update_voxel(evidence, 0, voted([1, 2], [1.0, 1.0], [4, 5], Combine.LATEST), COVERED)
    assert best_instance(evidence, 0) == 2
    assert best_class(evidence, 0) == 5
    assert (evidence.instance_ids[0, 1:] == 0).all()


def test_sum_rule_counts_observations() -> None:
    evidence = blank()
    for _ in range(3):
        assert update_voxel(evidence, 0, voted([7], [1.0], [2], Combine.SUM), COVERED) == 0
    assert evidence.instance_value[0].tolist() == [3, 0, 0, 0]
    assert evidence.class_value[0, 0] == 300, "expected 100 stored units per observation"
    assert evidence.class_ids[0].tolist() == [3, *[NO_CLASS] * (CLASS_SLOTS - 1)]


def test_compact_scores_saturate_without_wrapping() -> None:
    evidence = blank()._replace(class_value=np.zeros((1, CLASS_SLOTS), np.int16))
    measurement = voted([7, 7], [1.0, 1.0], [2, 3], Combine.SUM)._replace(max_score=MAX_SCORE)
    relative = np.zeros((2, 6))
    relative[:, 2], relative[:, 3] = MAX_CLUSTER_SCORE, -MAX_CLUSTER_SCORE
    bits = (measurement.class_scores & ALL_NAMED).astype(np.uint8)
    for _ in range(40):
        update_voxel(
            evidence, 0, measurement._replace(class_scores=pack_class_scores(relative, 1, bits, np.int32)), COVERED
        )
    assert evidence.class_value[0, :2].tolist() == [MAX_SCORE, -MAX_SCORE]
    assert best_class(evidence, 0) == 2


@pytest.mark.parametrize(("classes", "best"), [(2, 0.7), (3, 0.6), (9, 0.8), (80, 0.5)])
def test_most_likely_class_is_stable_over_repetition(classes: int, best: float) -> None:
    """The last class is more likely than the first class, and both are more likely than the others."""
    p = np.full((1, classes), 0.1 * (1 - best) / max(classes - 2, 1))
    p[0, 0], p[0, -1] = 1 - best - p[0, 1:-1].sum(), best
    relative, named, bits = named_classes(np.log(0.9 * p + 0.1 / classes), logarithmic=True)
    evidence = blank()._replace(class_value=np.zeros((1, CLASS_SLOTS), np.int16))
    measurement = measured([1], [0.9], p, 1.0, 1)._replace(
        class_scores=pack_class_scores(relative, 64, bits, np.int32), named_classes=named, max_score=MAX_SCORE
    )
    for _ in range(1000):
        update_voxel(evidence, 0, measurement, COVERED)
        assert best_class(evidence, 0) == classes - 1


def test_packed_scores_match_in_int32_and_int64() -> None:
    """The scores are the maximum of compact storage."""
    relative = np.array([[MAX_CLUSTER_SCORE, -MAX_CLUSTER_SCORE, 0.4, -0.6]])
    bits = np.array([[0, 1, 2, 4, 8]], np.uint8)
    narrow, wide = (pack_class_scores(relative, 1, bits, kind) for kind in (np.int32, np.int64))
    assert narrow.dtype == np.int32
    np.testing.assert_array_equal(narrow, wide)
    assert (wide[0] >> NEW_CLASSES).tolist() == [0, MAX_CLUSTER_SCORE, -MAX_CLUSTER_SCORE, 0, -1]
