"""Tests for detection statistics, with rectangles as masks."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Detections, FrameTruth
from framework.detection.masks.binary_masks import tight_boxes
from framework.evaluation.detection_errors import DetectionErrors, overlaps

CLASSES = ("chair", "bed")
SHAPE = (60, 80)
IDS = np.zeros(SHAPE, np.int32)
IDS[0:20, 0:20] = 3  # a chair
IDS[30:60, 0:40] = 4  # a bed
IDS[0:20, 40:60] = 7  # an object without a class
IDS[0:2, 70:72] = 9  # a chair below the minimum size
TRUTH = FrameTruth(IDS, {3: "chair", 4: "bed", 7: None, 9: "chair"})


def block(u: int, v: int, width: int, height: int) -> np.ndarray:
    mask = np.zeros(SHAPE, np.bool_)
    mask[v : v + height, u : u + width] = True
    return mask


def detections(*found: tuple[np.ndarray, int, float]) -> Detections:
    masks = np.array([mask for mask, _, _ in found], np.bool_).reshape(-1, *SHAPE)
    probabilities = np.full((len(found), 2), 0.1, np.float32)
    probabilities[np.arange(len(found)), [label for _, label, _ in found]] = 0.9
    scores = np.array([score for _, _, score in found], np.float32)
    return Detections(masks, tight_boxes(masks), scores, probabilities, CLASSES)


CHAIR, BED = block(0, 0, 20, 20), block(0, 30, 40, 30)


def counted(*frames: Detections) -> dict[str, float]:
    faults = DetectionErrors()
    for found in frames:
        faults.add(TRUTH, found)
    return faults.table()


def test_detection_errors_of_ground_truth_are_zero() -> None:
    table = counted(detections((CHAIR, 0, 0.8), (BED, 1, 0.6)))
    for name in (
        "found",
        "found, small",
        "found, medium",
        "mask IoU",
        "fraction of the mask on the object",
        "correct class",
    ):
        assert table[name] == 1, name
    assert np.isnan(table["found, large"])
    assert table["false detections per image"] == table["objects with several detections"] == 0
    assert table["score"] == pytest.approx(0.7)
    assert table["score, standard deviation"] == pytest.approx(0.1)


def test_detection_errors_oversized_mask_has_lower_iou() -> None:
    """The mask of 500 px covers 300 px of the chair, which has 400 px."""
    table = counted(detections((block(5, 0, 25, 20), 0, 0.8), (BED, 0, 0.6)))
    assert table["mask IoU"] == pytest.approx((300 / 600 + 1) / 2)
    assert table["fraction of the mask on the object"] == pytest.approx((300 / 500 + 1) / 2)
    assert table["fraction of the object in the mask"] == pytest.approx((300 / 400 + 1) / 2)
    assert table["correct class"] == 0.5


def test_detection_errors_split_object_has_no_false_positive() -> None:
    halves = detections((CHAIR, 0, 0.8), (block(0, 30, 20, 30), 1, 0.7), (block(20, 30, 20, 30), 1, 0.6))
    table = counted(halves)
    assert table["objects with several detections"] == 0.5
    assert table["false detections per image"] == 0
    assert table["found"] == 1


def test_detection_errors_count_false_detections() -> None:
    table = counted(detections((block(40, 0, 20, 20), 0, 0.5), (block(50, 40, 10, 10), 1, 0.2)), detections())
    assert table["false detections per image"] == 1
    assert table["false detections on an unknown object"] == 0.5
    assert table["score of false detections"] == pytest.approx(0.35)
    assert table["side of false detections (px)"] == pytest.approx((20 + 10) / 2)
    assert table["found"] == 0


def test_detection_errors_summarize_objects_over_frames() -> None:
    """The chair is found in all eight frames, once as another class. The bed is found in one frame."""
    frames = [detections((CHAIR, int(k == 3), 0.5), *([(BED, 1, 0.5)] if k == 0 else [])) for k in range(8)]
    table = counted(*frames)
    assert table["found"] == pytest.approx(9 / 16)
    assert table["objects found in < 1/4 of the frames"] == table["objects found in > 3/4 of the frames"] == 0.5
    assert table["same class as in the other frames"] == pytest.approx(7 / 8)
    assert table["correct class"] == pytest.approx(8 / 9)


def test_detection_errors_overlaps_match_whole_image_counts() -> None:
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 5, SHAPE).astype(np.int32) * 7
    masks = rng.random((4, *SHAPE)) < 0.3
    found, shared = overlaps(FrameTruth(ids, {}), masks)
    assert found.tolist() == [0, 7, 14, 21, 28]
    np.testing.assert_array_equal(shared[0], [(ids == i).sum() for i in found])
    np.testing.assert_array_equal(shared[1:], [[(mask & (ids == i)).sum() for i in found] for mask in masks])
