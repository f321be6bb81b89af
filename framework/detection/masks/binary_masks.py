"""Binary masks: creation from box grids or prototypes, bounding boxes, overlaps and duplicates."""

from __future__ import annotations

import math

import numpy as np

from framework.data import Bool, Detections, Float32, Float64, Int32
from framework.detection.masks.binary_masks_kernels import mask_bounds, paste, sample_prototypes, shared_pixels
from framework.detection.masks.letterbox import Letterbox


def paste_masks(grids: Float32, borders: Float32, shape: tuple[int, int], threshold: float = 0.5) -> Bool:
    """Return the masks (N, H, W) of grids of probabilities, resampled to their boxes in an image of `shape`.

    Pixels above `threshold` after bilinear interpolation are inside a mask. `grids`: (N, G, G) probabilities over each
    box. `borders`: (N, 4) boxes x1 y1 x2 y2 px, pixel centers at integers. The grids are padded with one cell of zeros,
    as in Detectron, so that a mask ends at the border of its box even if all cells are filled.
    """
    padded = np.pad(grids.astype(np.float32, copy=False), ((0, 0), (1, 1), (1, 1)))
    masks = np.zeros((len(grids), *shape), np.bool_)
    paste(padded, np.ascontiguousarray(borders, np.float64), np.float32(threshold), masks)
    return masks


def masks_from_prototypes(
    coefficients: Float32,
    prototypes: Float32,
    borders: Float32,
    letterbox: Letterbox,
    shape: tuple[int, int],
    threshold: float = 0.5,
) -> Bool:
    """Return the masks (N, H, W): thresholded weighted sums of prototypes (Bolya et al., "YOLACT").

    `coefficients`: (N, M). `prototypes`: (M, h, w), whose cells cover the complete input of the network. `borders`: (N,
    4) boxes x1 y1 x2 y2 px of the image, the limits of the masks. `letterbox`: the placement of the image in the input.
    `shape`: (height, width) px of the image. The sums are logits, interpolated bilinearly between cell centers.
    `threshold`: minimum mask probability of a pixel in the mask.
    """
    count, rows, columns = prototypes.shape
    logits = (coefficients @ prototypes.reshape(count, -1)).reshape(len(coefficients), rows, columns)
    cells_y, cells_x = rows / letterbox.input_shape[0], columns / letterbox.input_shape[1]  # cells per px of the input
    # pixel u maps to cell ((u + 0.5) scale + left) cells - 0.5, because centers map to centers
    affine = np.array(
        [
            [letterbox.scale_x * cells_x, (0.5 * letterbox.scale_x + letterbox.left) * cells_x - 0.5],
            [letterbox.scale_y * cells_y, (0.5 * letterbox.scale_y + letterbox.top) * cells_y - 0.5],
        ]
    )
    masks = np.zeros((len(coefficients), *shape), np.bool_)
    logit = np.float32(math.log(threshold / (1 - threshold)))
    logits, borders = np.ascontiguousarray(logits, np.float32), np.ascontiguousarray(borders, np.float64)
    sample_prototypes(logits, borders, affine, logit, masks)
    return masks


def tight_boxes(masks: Bool) -> Float32:
    """Return the boxes (N, 4) x1 y1 x2 y2 px of masks (N, H, W): first and last pixels inside; 0 for an empty mask."""
    return np.asarray(mask_bounds(masks.view(np.uint8)), np.float32)


def mask_overlaps(masks: Bool, boxes: Float32) -> Float64:
    """Return the intersections (N, N), in pixels, of masks (N, H, W); boxes (N, 4) must be their `tight_boxes`."""
    return np.asarray(shared_pixels(masks.view(np.uint8), boxes.astype(np.int64)), np.float64)


def suppress_duplicates(masks: Bool, boxes: Float32, iou: float) -> Int32:
    """Return the indices of the remaining masks after suppression of duplicates, best first.

    A mask is removed if it is empty or its IoU with a better remaining mask exceeds `iou`. `masks`: (N, H, W), best
    first. `boxes` (N, 4) must be their `tight_boxes`.
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
    """Return the detections of masks (N, H, W) after `suppress_duplicates`, with tight boxes."""
    boxes = tight_boxes(masks)
    kept = suppress_duplicates(masks, boxes, iou)
    return Detections(masks[kept], boxes[kept], scores[kept], class_probabilities[kept], classes)
