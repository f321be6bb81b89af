"""Masks of objects: from a network's small grid to the image, and the boxes around them."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Detections, Float32, Float64, Int32
from framework.detection.masks.binary_masks_kernels import mask_bounds, paste, shared_pixels


def paste_masks(grids: Float32, borders: Float32, shape: tuple[int, int], threshold: float = 0.5) -> Bool:
    """The masks (N, H, W) of an image of `shape` (height, width) where bilinearly resized grids exceed `threshold`.

    grids (N, G, G) probabilities over each box; borders (N, 4) x1 y1 x2 y2 of the boxes in px with pixel centres at
    integers. Around a grid there is a ring of zero cells, as in Detectron, so that an object that fills its box ends at
    the box, and not at the centre of the last cell.
    """
    ringed = np.pad(grids.astype(np.float32, copy=False), ((0, 0), (1, 1), (1, 1)))
    masks = np.zeros((len(grids), *shape), np.bool_)
    paste(ringed, np.ascontiguousarray(borders, np.float64), np.float32(threshold), masks)
    return masks


def tight_boxes(masks: Bool) -> Float32:
    """The (N, 4) boxes x1 y1 x2 y2 px of masks (N, H, W): first and last column and row inside; 0 for an empty mask."""
    return np.asarray(mask_bounds(masks.view(np.uint8)), np.float32)


def mask_overlaps(masks: Bool, boxes: Float32) -> Float64:
    """The (N, N) numbers of pixels that masks (N, H, W) share; on the diagonal their areas.

    boxes (N, 4) are `tight_boxes` of the masks, which is not checked.
    """
    return np.asarray(shared_pixels(masks.view(np.uint8), boxes.astype(np.int64)), np.float64)


def suppress_duplicates(masks: Bool, boxes: Float32, iou: float) -> Int32:
    """The indices of the masks (N, H, W), best first, that are not empty and overlap no better survivor by `iou`.

    boxes (N, 4) are the masks' tight ones.
    """
    overlaps = mask_overlaps(masks, boxes)
    areas = overlaps.diagonal()
    covered = overlaps > iou * (areas[:, None] + areas - overlaps)
    survives = areas > 0
    for i in range(1, len(masks)):
        survives[i] &= not (covered[i, :i] & survives[:i]).any()
    return np.flatnonzero(survives).astype(np.int32)


def without_duplicates(
    masks: Bool, scores: Float32, class_probabilities: Float32, classes: tuple[str, ...], iou: float
) -> Detections:
    """The detections, best first, whose masks (N, H, W) `suppress_duplicates` leaves, in tight boxes."""
    boxes = tight_boxes(masks)
    kept = suppress_duplicates(masks, boxes, iou)
    return Detections(masks[kept], boxes[kept], scores[kept], class_probabilities[kept], classes)
