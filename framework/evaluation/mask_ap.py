"""COCO mask AP (Lin et al. 2014), computed by pycocotools for all areas and at most 100 detections per image."""

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
class MaskAp:
    """Mask AP in [0, 1]; NaN without objects."""

    ap: float  # mean over IoU 0.5, 0.55, ..., 0.95 and over the classes
    ap50: float  # mean over the classes, at IoU 0.5
    ap50_by_class: Mapping[str, float]  # AP at IoU 0.5, by class
    objects: int  # number of evaluated ground-truth objects


def mask_ap(
    pictures: Iterable[tuple[Bool, Sequence[str | None], Detections]], classes: Sequence[str], min_pixels: int = 1
) -> MaskAp:
    """Return the AP over images and the given classes.

    The class of a detection is its most likely class. Objects of unknown class and objects with fewer than `min_pixels`
    pixels count neither for nor against a detection (COCO's `iscrowd`).

    Args:
        pictures: For each image, the ground-truth masks (N, H, W), their class names (N,), None = unknown, and the
            detections.
        classes: Names of the evaluated classes. Objects and detections of other classes are omitted.
        min_pixels: Minimum area of an evaluated object, px.
    """
    category = {name: k for k, name in enumerate(classes, start=1)}
    images: list[dict[str, int]] = []
    truths: list[dict[str, Any]] = []
    found: list[dict[str, Any]] = []
    for k, (masks, names, detections) in enumerate(pictures, start=1):
        height, width = detections.masks.shape[1:]
        images.append({"id": k, "height": height, "width": width})
        named = [(mask, name) for mask, name in zip(masks, names, strict=True) if name in category]
        objects = [(mask, category[str(name)], bool(mask.sum() < min_pixels)) for mask, name in named]
        unknown = masks[[name is None for name in names]].any(axis=0)
        if unknown.any():
            objects += [(unknown, label, True) for label in category.values()]
        for mask, label, ignored in objects:
            truth = _annotation(k, label, mask) | {"id": len(truths) + 1, "iscrowd": int(ignored)}
            truths.append(truth | {"area": int(mask.sum()), "bbox": [0, 0, width, height]})
        for mask, probabilities, score in zip(
            detections.masks, detections.class_probabilities, detections.scores.tolist(), strict=True
        ):
            name = detections.classes[int(probabilities.argmax())]
            if name in category:
                found.append(_annotation(k, category[name], mask) | {"score": score})
    counted = [truth["category_id"] for truth in truths if not truth["iscrowd"]]
    if not found or not counted:
        zero = 0.0 if counted else float("nan")
        present = {name: 0.0 if category[name] in counted else float("nan") for name in classes}
        return MaskAp(zero, zero, present, len(counted))
    categories = [{"id": k, "name": name} for name, k in category.items()]
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints progress
        coco = COCO()
        coco.dataset = {"images": images, "annotations": truths, "categories": categories}
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(found), "segm")
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]  # (IoU, recall, class), all areas, 100 detections
    by_class = {name: _mean(precision[0, :, k - 1]) for name, k in category.items()}
    return MaskAp(_mean(precision), _mean(precision[0]), by_class, len(counted))


def _annotation(image: int, category: int, mask: Bool) -> dict[str, Any]:
    """Return the COCO fields of a mask (H, W), with a run-length encoding; see pycocotools."""
    segmentation = rle.encode(np.asfortranarray(mask, np.uint8))
    return {"image_id": image, "category_id": category, "segmentation": segmentation}


def _mean(precision: np.ndarray) -> float:
    known = precision[precision > UNDEFINED]
    return float(known.mean()) if known.size else float("nan")
