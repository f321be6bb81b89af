"""Tests for ground-truth instances that a map contains more than once."""

from __future__ import annotations

from collections import Counter

import numpy as np

from framework.data import Camera
from framework.datasets.ground_truth.scene_truth import LabeledDepth
from framework.evaluation.doubled_instances import UNOBSERVED, doubled_instances, observed_labels
from framework.geometry import back_project

CAMERA = Camera(16, 12, 14.0, 14.0, 7.5, 5.5)


def view(depth: float, ids: np.ndarray, x: float = 0.0) -> LabeledDepth:
    T = np.eye(4)
    T[0, 3] = x
    return LabeledDepth(np.full(CAMERA.shape, depth, np.float32), ids.astype(np.int32), CAMERA, T)


def points(depth: float) -> np.ndarray:
    """Return a point in the middle of each pixel."""
    pixels = np.stack(np.meshgrid(np.arange(16), np.arange(12)), axis=-1).reshape(-1, 2).astype(np.int32)
    return back_project(CAMERA, pixels, np.full(len(pixels), depth, np.float32))


def halves(left: int, right: int) -> np.ndarray:
    return np.where(np.arange(16) < 8, left, right) * np.ones((12, 1), np.int64)


def test_observed_labels_are_those_of_images() -> None:
    labels = observed_labels(points(2.0), [view(2.0, halves(3, 0))])
    np.testing.assert_array_equal(labels.reshape(12, 16), halves(3, 0))


def test_observed_labels_are_most_frequent() -> None:
    ids = [halves(1, 2), halves(4, 2), halves(4, 5), halves(1, 5), halves(1, 2)]
    labels = observed_labels(points(2.0), [view(2.0, image) for image in ids])
    expected = [Counter(int(image[0, column]) for image in ids).most_common(1)[0][0] for column in range(16)]
    np.testing.assert_array_equal(labels.reshape(12, 16), np.tile(expected, (12, 1)))


def test_observed_labels_of_tie_are_smaller_ids() -> None:
    labels = observed_labels(points(2.0), [view(2.0, halves(7, 2)), view(2.0, halves(5, 9))])
    np.testing.assert_array_equal(labels.reshape(12, 16), halves(5, 2))


def test_vertices_apart_from_depth_or_outside_are_unobserved() -> None:
    labels = observed_labels(points(2.0), [view(2.3, halves(1, 2))])
    assert (labels == UNOBSERVED).all()
    labels = observed_labels(points(2.0), [view(2.0, halves(1, 2), x=100.0)])
    assert (labels == UNOBSERVED).all()
    assert len(observed_labels(np.zeros((0, 3), np.float32), [view(2.0, halves(1, 2))])) == 0
    assert (observed_labels(points(2.0), []) == UNOBSERVED).all()


def test_vertices_of_two_layers_have_labels_of_their_own_views() -> None:
    """The second layer is displaced by the drift of the camera."""
    vertices = np.concatenate([points(2.0), points(2.2)])
    labels = observed_labels(vertices, [view(2.0, halves(1, 0)), view(2.2, halves(1, 2))])
    np.testing.assert_array_equal(labels[: len(labels) // 2].reshape(12, 16), halves(1, 0))
    np.testing.assert_array_equal(labels[len(labels) // 2 :].reshape(12, 16), halves(1, 2))


def test_doubled_instances_are_covered_by_two_likely_instances() -> None:
    true_ids = np.repeat(np.int32([1, 2, 3, 4, 0, UNOBSERVED]), 100)
    instance_ids = np.zeros(600, np.int32)
    instance_ids[0:25], instance_ids[25:100] = 10, 11  # instance 1: two copies
    instance_ids[100:124], instance_ids[124:200] = 12, 13  # instance 2: one fragment is too small
    instance_ids[200:250], instance_ids[250:300] = 14, 15  # instance 3: one copy is unlikely
    instance_ids[300:400] = 16  # instance 4: one copy
    instance_ids[400:450], instance_ids[450:600] = 17, 18  # background
    likely = {10, 11, 12, 13, 14, 16, 17, 18}
    assert doubled_instances(true_ids, instance_ids, likely) == [1]
    assert doubled_instances(true_ids[::10], instance_ids[::10], likely) == [], "too few vertices"
