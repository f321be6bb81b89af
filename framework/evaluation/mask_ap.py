"""How good masks are, picture by picture: COCO's mask AP by its own reference implementation (pycocotools).

Lin et al., "Microsoft COCO" (2014): average precision over recall at IoU thresholds, all areas, at most 100 detections.
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

NOT_KNOWN = -1.0  # what pycocotools says of a class without an object


@dataclass(frozen=True)
class MaskAp:
    """In [0, 1]; NaN where there is no object."""

    ap: float  # mean over IoU 0.5, 0.55, ..., 0.95 and over the classes
    ap50: float  # mean over the classes, at IoU 0.5
    ap50_by_class: Mapping[str, float]
    objects: int


def mask_ap(
    pictures: Iterable[tuple[Bool, Sequence[str | None], Detections]], classes: Sequence[str], min_pixels: int = 1
) -> MaskAp:
    """The AP of the detections over pictures with true masks (N, H, W) and their class names (N,), None = not known.

    A detection counts as of its most likely class. Objects smaller than `min_pixels` count neither for nor against it
    (COCO's `iscrowd`), nor do objects of unknown class, whatever they are taken for.
    """
    number = {name: k for k, name in enumerate(classes, start=1)}
    images: list[dict[str, int]] = []
    truths: list[dict[str, Any]] = []
    found: list[dict[str, Any]] = []
    for k, (masks, names, detections) in enumerate(pictures, start=1):
        height, width = detections.masks.shape[1:]
        images.append({"id": k, "height": height, "width": width})
        objects = [(mask, number[name], mask.sum() < min_pixels) for mask, name in zip(masks, names, strict=True)
                   if name in number]  # fmt: skip
        unknown = masks[[name is None for name in names]].any(axis=0)
        if unknown.any():
            objects += [(unknown, label, True) for label in number.values()]
        for mask, label, ignored in objects:
            truths.append(
                {"id": len(truths) + 1, "image_id": k, "category_id": label, "segmentation": encoded(mask),
                 "area": int(mask.sum()), "bbox": [0, 0, width, height], "iscrowd": int(ignored)}
            )  # fmt: skip
        best = detections.class_probabilities.argmax(axis=1) if len(detections) else np.empty(0, np.int64)
        for mask, label, score in zip(detections.masks, best.tolist(), detections.scores.tolist(), strict=True):
            name = detections.classes[label]
            if name in number:
                found.append(
                    {"image_id": k, "category_id": number[name], "segmentation": encoded(mask), "score": score}
                )
    counted = [truth["category_id"] for truth in truths if not truth["iscrowd"]]
    if not found or not counted:
        zero = 0.0 if counted else float("nan")
        present = {name: 0.0 if number[name] in counted else float("nan") for name in classes}
        return MaskAp(zero, zero, present, len(counted))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints as it goes
        truth = COCO()
        truth.dataset = {
            "images": images,
            "annotations": truths,
            "categories": [{"id": k, "name": name} for name, k in number.items()],
        }
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(found), "segm")
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]  # (IoU, recall, class), all areas, 100 detections
    by_class = {name: _mean(precision[0, :, k - 1]) for name, k in number.items()}
    return MaskAp(_mean(precision), _mean(precision[0]), by_class, len(counted))


def encoded(mask: Bool) -> dict[str, Any]:
    """COCO's run-length encoding of a mask (H, W)."""
    encoding: dict[str, Any] = rle.encode(np.asfortranarray(mask, np.uint8))
    return encoding


def _mean(precision: np.ndarray) -> float:
    known = precision[precision > NOT_KNOWN]
    return float(known.mean()) if known.size else float("nan")
