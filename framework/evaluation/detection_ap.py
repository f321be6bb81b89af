"""COCO average precision (AP) of masks and boxes, computed by pycocotools.

AP is computed over objects of all areas, with at most 100 detections per image (Lin et al. 2014).
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pycocotools import mask as rle
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from framework.data import Bool, Detections

UNDEFINED = -1.0  # precision of a class without objects in pycocotools


@dataclass(frozen=True)
class AveragePrecision:
    """Average precision (AP), in [0, 1]. Values are NaN without objects."""

    ap: float  # mean over IoU 0.5, 0.55, ..., 0.95 and over the classes
    ap50: float  # mean over the classes, at IoU 0.5
    ap50_by_class: Mapping[str, float]  # AP at IoU 0.5, by class
    objects: int  # number of evaluated ground-truth objects


@dataclass(frozen=True)
class DetectionAp:
    """Average precision of masks and of boxes."""

    masks: AveragePrecision
    boxes: AveragePrecision


def detection_ap(
    pictures: Iterable[tuple[Bool, Sequence[str | None], Detections]], classes: Sequence[str], min_pixels: int = 1
) -> DetectionAp:
    """Return the average precision of detections over images and classes.

    The class of a detection is its most likely class. Objects of unknown class and objects smaller than `min_pixels`
    are ignored, as with `iscrowd` in COCO. The box of a ground-truth object is the bounding box of its mask.

    Args:
        pictures: Ground truth and detections of each image. The ground truth consists of masks (N, H, W) and class
            names (N,), None = unknown.
        classes: Names of the evaluated classes. Objects and detections of other classes are omitted.
        min_pixels: Minimum area of an evaluated object, px.
    """
    category = {name: k for k, name in enumerate(classes, start=1)}
    images: list[dict[str, int]] = []
    known: list[dict[str, Any]] = []
    unknown: dict[str, list[dict[str, Any]]] = {"segm": [], "bbox": []}
    found: list[dict[str, Any]] = []
    for k, (masks, names, detections) in enumerate(pictures, start=1):
        height, width = detections.masks.shape[1:]
        images.append({"id": k, "height": height, "width": width})
        for mask, name in zip(masks, names, strict=True):
            if name in category:
                known.append(_annotation(k, category[str(name)], mask) | {"iscrowd": int(mask.sum() < min_pixels)})
        detected = set()
        for mask, (x1, y1, x2, y2), probabilities, score in zip(
            detections.masks,
            detections.boxes.tolist(),
            detections.class_probabilities,
            detections.scores.tolist(),
            strict=True,
        ):
            name = detections.classes[int(probabilities.argmax())]
            if name in category:
                # x2 and y2 are the last column and row inside the box
                box = {"bbox": [x1, y1, x2 - x1 + 1, y2 - y1 + 1], "score": score}
                found.append(_annotation(k, category[name], mask) | box)
                detected.add(category[name])
        without_class = masks[[name is None for name in names]]
        for label in sorted(detected):  # in other classes there is no detection to ignore
            if len(without_class):  # a mask may cover several objects; the box around all of them would be too large
                covered: Bool = np.asarray(without_class.any(axis=0))
                unknown["segm"].append(_annotation(k, label, covered) | {"iscrowd": 1})
            unknown["bbox"] += [_annotation(k, label, mask) | {"iscrowd": 1} for mask in without_class]
    counted = [truth["category_id"] for truth in known if not truth["iscrowd"]]

    def precision(kind: str) -> AveragePrecision:
        if not found or not counted:
            zero = 0.0 if counted else float("nan")
            present = {name: 0.0 if category[name] in counted else float("nan") for name in classes}
            return AveragePrecision(zero, zero, present, len(counted))
        truths = [truth | {"id": k} for k, truth in enumerate([*known, *unknown[kind]], start=1)]
        categories = [{"id": k, "name": name} for name, k in category.items()]
        by_class = _precision({"images": images, "annotations": truths, "categories": categories}, found, kind)
        ap50_by_class = {name: _mean(by_class[0, :, k - 1]) for name, k in category.items()}
        return AveragePrecision(_mean(by_class), _mean(by_class[0]), ap50_by_class, len(counted))

    return DetectionAp(precision("segm"), precision("bbox"))


def _annotation(image: int, category: int, mask: Bool) -> dict[str, Any]:
    segmentation = rle.encode(np.asfortranarray(mask, np.uint8))
    return {
        "image_id": image,
        "category_id": category,
        "segmentation": segmentation,
        "area": int(mask.sum()),
        "bbox": rle.toBbox(segmentation).tolist(),
    }


def _precision(truth: dict[str, Any], found: list[dict[str, Any]], kind: str) -> np.ndarray:
    """Return the precision by IoU threshold, recall and class.

    `kind` selects the IoU of masks ("segm") or of boxes ("bbox").
    """
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints progress
        coco = COCO()
        coco.dataset = truth
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes([dict(one) for one in found]), kind)
        evaluation.evaluate()
        evaluation.accumulate()
    return np.asarray(evaluation.eval["precision"][:, :, :, 0, -1])  # all areas, 100 detections


def _mean(precision: np.ndarray) -> float:
    known = precision[precision > UNDEFINED]
    return float(known.mean()) if known.size else float("nan")
