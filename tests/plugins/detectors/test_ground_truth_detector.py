"""Tests for detector=ground_truth and detector=none."""

import numpy as np
import pytest

from framework.data import Camera, Frame, FrameTruth
from framework.errors import ConfigError, DataError
from framework.vocabulary.label_spaces import COCO
from plugins.detectors.ground_truth import GroundTruthDetector
from plugins.detectors.none import NoDetections

CAMERA = Camera(40, 30, 50.0, 50.0, 19.5, 14.5)


def frame_with(truth):
    return Frame(3, 0.1, np.zeros((30, 40, 3), np.uint8), np.ones((30, 40), np.float32), CAMERA, truth=truth)


def test_ground_truth_masks_of_known_classes_are_exact():
    ids = np.zeros((30, 40), np.int32)
    ids[2:12, 3:23], ids[15:25, 5:15], ids[20:30, 30:40], ids[0, :9] = 8, 3, 1000, 4
    detections = GroundTruthDetector(min_pixels=10).detect(
        frame_with(FrameTruth(ids, {8: "chair", 3: "tv", 1000: None, 4: "cup"}))
    )
    assert len(detections) == 2  # 1000 has no class, and 4 is too small
    np.testing.assert_array_equal(detections.masks[0], ids == 8)
    np.testing.assert_array_equal(detections.masks[1], ids == 3)
    np.testing.assert_array_equal(detections.boxes, [[3, 2, 22, 11], [5, 15, 14, 24]])
    assert (detections.scores == 1).all()
    assert detections.class_probabilities[0, COCO.index("chair")] == 1
    assert detections.class_probabilities[1, COCO.index("tv")] == 1


def test_ground_truth_frame_without_instances_has_no_detections():
    empty = FrameTruth(np.zeros((30, 40), np.int32), {})
    assert len(GroundTruthDetector().detect(frame_with(empty))) == 0


def test_ground_truth_missing_in_frame_raises():
    with pytest.raises(DataError, match="expected instance ground truth"):
        GroundTruthDetector().detect(frame_with(None))


def test_ground_truth_invalid_parameter_raises():
    with pytest.raises(ConfigError, match=r"detector\.min_pixels: expected at least 1 px, got 0"):
        GroundTruthDetector(min_pixels=0)


def test_none_detector_returns_no_detections():
    detections = NoDetections().detect(frame_with(None))
    assert detections.masks.shape == (0, 30, 40)
    assert detections.classes == COCO
