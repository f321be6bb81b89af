"""Tests for the AP of masks and boxes, compared with manual results and pycocotools."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from framework.data import Detections
from framework.detection.masks.binary_masks import tight_boxes
from framework.evaluation.detection_ap import AveragePrecision, detection_ap

CLASSES = ("chair", "bed")
SHAPE = (40, 60)

Picture = tuple[np.ndarray, Sequence[str | None], Detections]


def mask_ap(pictures: Sequence[Picture], classes: Sequence[str], min_pixels: int = 1) -> AveragePrecision:
    return detection_ap(pictures, classes, min_pixels).masks


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


def with_boxes(found: Detections, boxes: Sequence[Sequence[float]]) -> Detections:
    return replace(found, boxes=np.array(boxes, np.float32))


def test_box_ap_depends_only_on_boxes() -> None:
    """First, the box is correct and the mask covers 30% of the object.

    Then, the mask is correct and the box covers 60%.
    """
    masks = np.array([block(0, 0)])
    part = with_boxes(detections([block(0, 0, 3, 10)], (0,), (0.9,)), [[0, 0, 9, 9]])
    result = detection_ap([(masks, ("chair",), part)], CLASSES)
    assert (result.masks.ap50, result.boxes.ap50, result.boxes.ap) == (0, pytest.approx(1), pytest.approx(1))
    narrow = with_boxes(detections([block(0, 0)], (0,), (0.9,)), [[0, 0, 5, 9]])
    result = detection_ap([(masks, ("chair",), narrow)], CLASSES)
    assert (result.masks.ap, result.boxes.ap50) == (pytest.approx(1), pytest.approx(1))
    assert result.boxes.ap == pytest.approx(3 / 10)  # 0.5, 0.55, 0.6
    assert result.boxes.objects == 1


def test_box_ap_detection_between_unknown_objects_is_wrong() -> None:
    """The detection is inside the common box of both unknown objects, but overlaps neither."""
    masks = np.array([block(0, 0), block(0, 25), block(40, 25)])
    on_one = detections([block(40, 25), block(0, 0)], (0, 0), (0.9, 0.4))
    between = detections([block(20, 25), block(0, 0)], (0, 0), (0.9, 0.4))
    for found, ap50 in ((on_one, 1.0), (between, 0.5)):
        result = detection_ap([(masks, ("chair", None, None), found)], CLASSES)
        assert result.boxes.ap50 == pytest.approx(ap50)
        assert result.masks.ap50 == pytest.approx(ap50)


def test_detection_ap_matches_coco_files(tmp_path: Path) -> None:
    """The reference is pycocotools, applied to files with random boxes and filled masks."""
    rng = np.random.default_rng(0)
    pictures: list[Picture] = []
    annotations, results = [], []
    for image in range(1, 9):
        masks = np.array([block(*rng.integers(0, (40, 20)), *rng.integers(5, 16, 2)) for _ in range(4)])
        labels = rng.integers(0, 2, 4)
        names = [CLASSES[k] for k in labels]
        moved = [np.roll(mask, rng.integers(-1, 2, 2), (0, 1)) for mask in masks]
        found = detections(moved, (labels ^ (rng.random(4) < 0.2)).tolist(), np.sort(rng.random(4))[::-1].tolist())
        pictures.append((masks, names, found))
        for mask, name in zip(masks, names, strict=True):
            (x1, y1, x2, y2) = tight_boxes(mask[None])[0].tolist()
            box = {"bbox": [x1, y1, x2 - x1 + 1, y2 - y1 + 1], "area": int(mask.sum()), "iscrowd": 0}
            label = {"image_id": image, "category_id": CLASSES.index(name), "id": len(annotations) + 1}
            annotations.append(label | box)
        for (x1, y1, x2, y2), row, score in zip(
            found.boxes.tolist(), found.class_probabilities, found.scores.tolist(), strict=True
        ):
            box = {"bbox": [x1, y1, x2 - x1 + 1, y2 - y1 + 1], "score": score}
            results.append({"image_id": image, "category_id": int(row.argmax())} | box)
    truth = {
        "info": {},
        "images": [{"id": image, "height": SHAPE[0], "width": SHAPE[1]} for image in range(1, 9)],
        "annotations": annotations,
        "categories": [{"id": k, "name": name} for k, name in enumerate(CLASSES)],
    }
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    (tmp_path / "results.json").write_text(json.dumps(results))
    coco = COCO(str(tmp_path / "truth.json"))
    evaluation = COCOeval(coco, coco.loadRes(str(tmp_path / "results.json")), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    result = detection_ap(pictures, CLASSES)
    assert 0.05 < result.boxes.ap < 0.95
    assert result.boxes.ap == pytest.approx(evaluation.stats[0])
    assert result.boxes.ap50 == pytest.approx(evaluation.stats[1])
