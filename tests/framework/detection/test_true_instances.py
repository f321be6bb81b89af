"""Tests for the ground-truth instances of a frame."""

import numpy as np
import pytest

from framework.data import Camera, Frame, FrameTruth
from framework.detection.true_instances import true_instances
from framework.errors import DataError, FrameError

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)


def frame_with(truth):
    return Frame(7, 0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), CAMERA, truth=truth)


def test_true_instances_are_known_classes_largest_first():
    ids = np.zeros((6, 8), np.int32)
    ids[0, :3], ids[1, :], ids[2:4, :2], ids[5, :2] = 9, 4, 2, 5
    truth = true_instances(
        frame_with(FrameTruth(ids, {9: "chair", 4: None, 2: "tv", 5: "chair", 77: "bed"})), ("tv", "bed", "chair")
    )
    assert truth.ids.tolist() == [2, 9, 5]
    assert truth.class_ids.tolist() == [0, 2, 2]
    assert np.count_nonzero(truth.masks, axis=(1, 2)).tolist() == [4, 3, 2]
    np.testing.assert_array_equal(truth.masks[1], ids == 9)
    assert len(true_instances(frame_with(FrameTruth(ids, {9: "chair", 5: "chair"})), ("chair",), min_pixels=3)) == 1


def test_true_instances_without_visible_instance_are_empty():
    assert true_instances(frame_with(FrameTruth(np.zeros((6, 8), np.int32), {})), ("tv",)).masks.shape == (0, 6, 8)


def test_true_instances_missing_truth_or_unknown_class_raises():
    with pytest.raises(DataError, match="frame 7: expected instance ground truth, got none") as caught:
        true_instances(frame_with(None), ("tv",))
    assert not isinstance(caught.value, FrameError)
    ids = np.ones((6, 8), np.int32)
    with pytest.raises(DataError, match="classes of the detector, got 'sofa'"):
        true_instances(frame_with(FrameTruth(ids, {1: "sofa"})), ("tv",))
