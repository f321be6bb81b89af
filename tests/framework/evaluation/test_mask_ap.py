"""Tests of mask AP on masks with hand-computed results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from framework.data import Detections
from framework.detection.masks.binary_masks import tight_boxes
from framework.evaluation.mask_ap import mask_ap

CLASSES = ("chair", "bed")
SHAPE = (40, 60)


def block(u: int, v: int, width: int = 10, height: int = 10) -> np.ndarray:
    mask = np.zeros(SHAPE, np.bool_)
    mask[v : v + height, u : u + width] = True
    return mask


def detections(masks: Sequence[np.ndarray], labels: Sequence[int], scores: Sequence[float]) -> Detections:
    stack = np.array(masks, np.bool_).reshape(-1, *SHAPE)
    probabilities = np.full((len(masks), 2), 0.1, np.float32)
    probabilities[np.arange(len(masks)), list(labels)] = 0.9
    return Detections(stack, tight_boxes(stack), np.array(scores, np.float32), probabilities, CLASSES)


def test_mask_ap_of_exact_masks_is_one() -> None:
    masks = np.array([block(0, 0), block(30, 20)])
    result = mask_ap([(masks, ("chair", "bed"), detections(list(masks), (0, 1), (0.9, 0.4)))], CLASSES)
    assert result.ap == pytest.approx(1)
    assert result.ap50 == pytest.approx(1)
    assert result.objects == 2


def test_mask_ap_higher_scored_false_positive_halves_ap() -> None:
    masks = np.array([block(0, 0)])
    found = detections([block(30, 20), block(0, 0)], (0, 0), (0.9, 0.4))
    result = mask_ap([(masks, ("chair",), found)], CLASSES)
    assert result.ap50 == pytest.approx(0.5)
    assert np.isnan(result.ap50_by_class["bed"])


def test_mask_ap_half_recall_gives_half_ap() -> None:
    masks = np.array([block(0, 0), block(30, 20)])
    result = mask_ap([(masks, ("chair", "chair"), detections([block(0, 0)], (0,), (0.9,)))], CLASSES)
    assert result.ap50 == pytest.approx(51 / 101)  # recall is sampled at 0, 0.01, ..., 1


def test_mask_ap_wrong_class_is_zero() -> None:
    masks = np.array([block(0, 0)])
    result = mask_ap([(masks, ("chair",), detections([block(0, 0)], (1,), (0.9,)))], CLASSES)
    assert result.ap50 == 0


def test_mask_ap_iou_of_60_percent_counts_at_lower_thresholds() -> None:
    result = mask_ap([(np.array([block(0, 0)]), ("chair",), detections([block(0, 0, 6, 10)], (0,), (0.9,)))], CLASSES)
    assert result.ap50 == pytest.approx(1)
    assert result.ap == pytest.approx(3 / 10)  # 0.5, 0.55, 0.6


def test_mask_ap_small_and_other_class_objects_are_ignored() -> None:
    masks = np.array([block(0, 0), block(30, 20, 3, 3), block(45, 25)])
    found = detections([block(0, 0), block(30, 20, 3, 3)], (0, 0), (0.5, 0.9))
    result = mask_ap([(masks, ("chair", "chair", "tv"), found)], CLASSES, min_pixels=50)
    assert result.ap50 == pytest.approx(1)
    assert result.objects == 1


@pytest.mark.parametrize(("name", "ap50"), [(None, 1.0), ("tv", 0.5)])
def test_mask_ap_only_detections_on_unknown_class_are_ignored(name: str | None, ap50: float) -> None:
    masks = np.array([block(0, 0), block(30, 20)])
    found = detections([block(30, 20), block(0, 0)], (0, 0), (0.9, 0.4))
    result = mask_ap([(masks, ("chair", name), found)], CLASSES)
    assert result.ap50 == pytest.approx(ap50)
    assert result.objects == 1


@pytest.mark.parametrize("names", [(), ("chair",)])
def test_mask_ap_without_detections_is_zero_or_nan(names: tuple[str, ...]) -> None:
    masks = np.array([block(0, 0)] * len(names), np.bool_).reshape(-1, *SHAPE)
    result = mask_ap([(masks, names, Detections.none(SHAPE, CLASSES))], CLASSES)
    assert result.objects == len(names)
    assert (result.ap50 == 0) if names else np.isnan(result.ap50)
