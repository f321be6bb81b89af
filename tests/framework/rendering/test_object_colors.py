"""Tests for object matching between several maps of a scene."""

from __future__ import annotations

import numpy as np

from framework.data import SceneTruth
from framework.rendering.object_colors import UNKNOWN, ObjectColors, relabeled, same_objects
from framework.rendering.palette import CLEAR, candidates

TRUE = np.repeat([0, 900000, 20, 30], [40, 40, 20, 20]).astype(np.int32)


def truth() -> SceneTruth:
    points = np.random.default_rng(0).uniform(0, 3, (len(TRUE), 3)).astype(np.float32)
    return SceneTruth(points, TRUE, {900000: "bed", 20: "chair", 30: None})


def ids(*runs: tuple[int, int]) -> np.ndarray:
    return np.repeat([label for label, _ in runs], [count for _, count in runs]).astype(np.int32)


def test_same_objects_is_one_to_one() -> None:
    # 5 covers most of the bed, 6 a part of the bed, 7 the chair and half of object 30, and 8 a part of the wall
    found = ids((0, 30), (8, 10), (5, 30), (6, 10), (7, 30), (0, 10))
    assert same_objects(found, TRUE) == {5: 900000, 7: 20}  # the IoUs are 30 / 40 and 20 / 30; 6 overlaps only the bed


def test_same_objects_maximizes_total_overlap() -> None:
    true = ids((1, 50), (2, 30))
    # 5 covers 20 of the 50 points of 1 and all points of 2; 6 covers 30 points of 1
    found = ids((5, 20), (6, 30), (5, 30))
    assert same_objects(found, true) == {5: 2, 6: 1}


def test_same_objects_requires_minimum_iou() -> None:
    assert same_objects(ids((0, 40), (5, 9), (0, 71)), TRUE) == {}
    assert same_objects(ids((0, 40), (5, 10), (0, 70)), TRUE) == {5: 900000}  # the minimum IoU is 10 / 40


def test_same_objects_without_points_or_instances_is_empty() -> None:
    nothing = np.zeros(0, np.int32)
    assert same_objects(nothing, nothing) == {}
    assert same_objects(np.zeros_like(TRUE), TRUE) == {}
    assert same_objects(TRUE, np.zeros_like(TRUE)) == {}


def test_object_colors_are_shared_only_by_matched_objects() -> None:
    colors = ObjectColors(truth())
    first = colors.objects(ids((8, 40), (5, 40), (7, 20), (0, 20)), TRUE)
    second = colors.objects(ids((0, 10), (3, 30), (1, 40), (9, 20), (2, 20)), TRUE)
    assert (first[5], first[7]) == (second[1], second[9]) == (colors.true_objects[900000], colors.true_objects[20])
    assert first[8] != second[3], "expected distinct colors for objects of different maps"
    clear = {tuple(color) for color in candidates(CLEAR).tolist()}
    color_of = {key: tuple(color.tolist()) for key, color in colors.color_of.items()}
    assert {color_of[first[5]], color_of[first[7]]} < clear
    assert color_of[first[5]] != color_of[first[7]]
    assert color_of[first[8]] not in clear
    assert color_of[second[2]] == UNKNOWN  # object 30 has no class
    assert colors.name_of == {first[5]: "bed", first[7]: "chair"}


def test_object_colors_relabeled_maps_unknown_ids_to_zero() -> None:
    np.testing.assert_array_equal(relabeled(ids((4, 2), (0, 1), (9, 1)), {4: 1}), [1, 1, 0, 0])
