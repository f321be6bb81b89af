"""Binary masks: conversion from network outputs, bounding boxes, overlaps and duplicates."""

from __future__ import annotations

import math

import numpy as np

from framework.data import Bool, Detections, Float32, Float64, Int32
from framework.detection.masks.binary_masks_kernels import mask_bounds, paste, sample_prototypes, shared_pixels
from framework.detection.masks.letterbox import Letterbox


def paste_masks(grids: Float32, borders: Float32, shape: tuple[int, int], threshold: float = 0.5) -> Bool:
    """Resample mask probabilities of boxes to the image and return the masks (N, H, W).

    The grids are padded with zeros, as in Detectron, so that each mask ends at the border of its box.

    Args:
        grids: The mask probabilities (N, G, G) on a grid over each box.
        borders: The boxes (N, 4) x1 y1 x2 y2, px, with pixel centers at integers.
        shape: The image size (height, width), px.
        threshold: The minimum probability of a pixel in the mask.
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
    """Compute masks (N, H, W) as weighted sums of prototypes (Bolya et al., "YOLACT", 2019).

    Args:
        coefficients: The weights (N, M) of the prototypes.
        prototypes: The prototypes (M, h, w), which cover the complete input of the network.
        borders: The boxes (N, 4) x1 y1 x2 y2 in the image, px. Masks are limited to their boxes.
        letterbox: The placement of the image in the input of the network.
        shape: The image size (height, width), px.
        threshold: The minimum probability of a pixel in the mask.
    """
    count, rows, columns = prototypes.shape
    logits = (coefficients @ prototypes.reshape(count, -1)).reshape(len(coefficients), rows, columns)
    return masks_from_grids(logits, borders, letterbox, shape, math.log(threshold / (1 - threshold)))


def masks_from_grids(
    grids: Float32, borders: Float32, letterbox: Letterbox, shape: tuple[int, int], threshold: float
) -> Bool:
    """Resample grids over the complete input of a network to the image, and return the masks (N, H, W).

    Args:
        grids: The logits or probabilities (N, h, w).
        borders: The boxes (N, 4) x1 y1 x2 y2 in the image, px. Masks are limited to their boxes.
        letterbox: The placement of the image in the input of the network.
        shape: The image size (height, width), px.
        threshold: The minimum value of a pixel in the mask.
    """
    rows, columns = grids.shape[1:]
    cells_y, cells_x = rows / letterbox.input_shape[0], columns / letterbox.input_shape[1]  # cells per px of the input
    # pixel u maps to cell ((u + 0.5) scale + left) cells - 0.5, because centers map to centers
    affine = np.array(
        [
            [letterbox.scale_x * cells_x, (0.5 * letterbox.scale_x + letterbox.left) * cells_x - 0.5],
            [letterbox.scale_y * cells_y, (0.5 * letterbox.scale_y + letterbox.top) * cells_y - 0.5],
        ]
    )
    masks = np.zeros((len(grids), *shape), np.bool_)
    grids, borders = np.ascontiguousarray(grids, np.float32), np.ascontiguousarray(borders, np.float64)
    sample_prototypes(grids, borders, affine, np.float32(threshold), masks)
    return masks


def tight_boxes(masks: Bool) -> Float32:
    """Return the bounding boxes (N, 4) x1 y1 x2 y2, px, of masks (N, H, W).

    The borders are the first and last pixels in the mask. The box of an empty mask is 0.
    """
    return np.asarray(mask_bounds(masks.view(np.uint8)), np.float32)


def mask_overlaps(masks: Bool, boxes: Float32) -> Float64:
    """Return the number of common pixels (N, N) for each pair of masks.

    Args:
        masks: The masks (N, H, W).
        boxes: The bounding boxes (N, 4) from `tight_boxes`.
    """
    return np.asarray(shared_pixels(masks.view(np.uint8), boxes.astype(np.int64)), np.float64)


def suppress_duplicates(masks: Bool, boxes: Float32, iou: float) -> Int32:
    """Return the indices of masks that are neither empty nor duplicates of a better mask.

    Args:
        masks: The masks (N, H, W), best first.
        boxes: The bounding boxes (N, 4) from `tight_boxes`.
        iou: The IoU above which the worse of two masks is a duplicate.
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
    """Return detections with bounding boxes, without empty masks and duplicates.

    Args:
        masks: The masks (N, H, W), best first.
        scores: The scores (N,).
        class_probabilities: The class distributions (N, C).
        classes: The class names.
        iou: The IoU above which the worse of two masks is a duplicate.
    """
    boxes = tight_boxes(masks)
    kept = suppress_duplicates(masks, boxes, iou)
    return Detections(masks[kept], boxes[kept], scores[kept], class_probabilities[kept], classes)
