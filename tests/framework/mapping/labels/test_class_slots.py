"""Tests for vectorized class slots, compared with scalar loops."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from framework.data import MAX_CLASSES
from framework.mapping.labels import class_slots
from framework.mapping.labels.class_slots import CLASS_SLOTS, NEW_CLASSES, NO_CLASS, class_id_type
from framework.mapping.labels.label_evidence import MAX_CLUSTER_SCORE, MAX_SCORE

FEW, LVIS = 255, 1203  # number of classes with ids of one and two bytes


@njit
def add_scores(classes, scores, cluster_scores, limit):
    return class_slots.add_scores(classes, scores, cluster_scores, limit)


@njit
def most_likely_slot(classes, scores):
    return class_slots.most_likely_slot(classes, scores)


@njit
def least_likely_slot(scores):
    return class_slots.least_likely_slot(scores)


def voxel(seed: int, largest: int, count: int = FEW) -> tuple[np.ndarray, np.ndarray]:
    """Return the classes and scores of a voxel with randomly many filled slots.

    The scores are in [-largest, largest], and the vocabulary has `count` classes.
    """
    rng = np.random.default_rng(seed)
    filled = rng.integers(0, CLASS_SLOTS + 1)
    classes = np.full(CLASS_SLOTS, NO_CLASS, class_id_type(count))
    classes[:filled] = 1 + rng.choice(count, filled, replace=False)
    scores = np.zeros(CLASS_SLOTS, np.int16)
    scores[:filled] = rng.integers(-largest, largest + 1, filled)
    return classes, scores


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 100_000), st.sampled_from([1, 5, MAX_SCORE]), st.sampled_from([FEW, LVIS, MAX_CLASSES]))
def test_class_slots_vectorized_match_loops(seed: int, largest: int, count: int) -> None:
    classes, scores = voxel(seed, largest, count)
    rng = np.random.default_rng(seed)
    cluster_scores = rng.integers(-MAX_CLUSTER_SCORE, MAX_CLUSTER_SCORE + 1, count + 1).astype(np.int32)
    cluster_scores <<= NEW_CLASSES
    cluster_scores[:: rng.integers(2, 9)] |= 1 << rng.integers(0, NEW_CLASSES)
    cluster_scores[NO_CLASS] = 0
    by_loop = scores.astype(np.int64)

    assert most_likely_slot(classes, scores) == class_slots._most_likely_slot(classes, by_loop)
    assert least_likely_slot(scores) == class_slots._least_likely_slot(by_loop)
    assert add_scores(classes, scores, cluster_scores, MAX_SCORE) == class_slots._add_scores(
        classes, by_loop, cluster_scores.astype(np.int64), MAX_SCORE
    )
    np.testing.assert_array_equal(scores, by_loop)


def test_class_slots_exact_storage_handles_80_classes() -> None:
    classes, scores = np.arange(1, 81, dtype=np.uint8), np.arange(80) ** 2
    cluster_scores = np.full(81, 3 << NEW_CLASSES)
    assert most_likely_slot(classes, scores) == 79
    assert least_likely_slot(scores) == 0
    assert add_scores(classes, scores, cluster_scores, 1 << 62) == (0, 80, 79**2 + 3 - (1 << 62))
    np.testing.assert_array_equal(scores, np.arange(80) ** 2 + 3)


def test_add_scores_unaligned_slots_matches_reference() -> None:
    """The slots are fields of a structured array."""
    record = np.dtype([("flag", np.uint8), ("classes", np.uint8, (CLASS_SLOTS,)), ("scores", np.int16, (CLASS_SLOTS,))])
    records = np.zeros(3, record)
    for i, seed in enumerate((3, 4, 5)):
        records["classes"][i], records["scores"][i] = voxel(seed, 5)
    cluster_scores = (np.arange(FEW + 1, dtype=np.int32) % 7) << NEW_CLASSES
    before = records.copy()
    expected = records["scores"][1].astype(np.int64)
    answer = class_slots._add_scores(records["classes"][1], expected, cluster_scores.astype(np.int64), MAX_SCORE)
    assert add_scores(records["classes"][1], records["scores"][1], cluster_scores, MAX_SCORE) == answer
    np.testing.assert_array_equal(records["scores"][1], expected)
    np.testing.assert_array_equal(records[[0, 2]], before[[0, 2]])
