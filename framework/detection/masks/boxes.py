"""Bounding boxes x1 y1 x2 y2 in px: anchors, deltas and non-maximum suppression.

There are two conventions, and a network requires the convention of its training. With `extent` = 1 (older), x2 is the
last pixel inside, and the width is x2 - x1 + 1 px. With `extent` = 0 (newer), x2 is the right border.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Int32
from framework.detection.masks.boxes_kernels import suppress_sorted

LARGEST_LOG_SCALE = float(np.log(1000.0 / 16.0))
"""Maximum log scale of a box, to prevent overflow (Girshick et al., github.com/facebookresearch/Detectron)."""


def anchor_grid(anchors: Float32, rows: int, columns: int, stride: float | tuple[float, float]) -> Float32:
    """Return the anchors (rows * columns * A, 4), px, of all cells of a feature map.

    Args:
        anchors: The anchors (A, 4) of the first cell, px.
        rows: The number of rows of the feature map.
        columns: The number of columns of the feature map.
        stride: The size of a cell, px, for both axes or as (y, x).
    """
    stride_y, stride_x = stride if isinstance(stride, tuple) else (stride, stride)
    x, y = np.meshgrid(np.arange(columns) * stride_x, np.arange(rows) * stride_y)
    shifts = np.stack([x, y, x, y], axis=-1).reshape(-1, 1, 4)
    return np.asarray(shifts + anchors, np.float32).reshape(-1, 4)


def decode(boxes: Float32, deltas: Float32, extent: float = 1.0) -> Float32:
    """Apply predicted deltas to boxes and return the refined boxes (N, 4), px.

    Source: Girshick et al., "Rich feature hierarchies ...", 2014, appendix C, with Detectron's pixel conventions.

    Args:
        boxes: The boxes (N, 4), px.
        deltas: The deltas (N, 4) dx dy dw dh. The shifts dx and dy are in units of the box size, and dw and dh are
            logarithms of scale factors.
        extent: The box convention.
    """
    sizes = boxes[:, 2:] - boxes[:, :2] + np.float32(extent)
    centers = boxes[:, :2] + sizes * np.float32(0.5)
    centers = deltas[:, :2] * sizes + centers
    sizes = sizes * np.exp(np.minimum(deltas[:, 2:], np.float32(LARGEST_LOG_SCALE)))
    half = sizes * np.float32(0.5)
    return np.concatenate([centers - half, centers + half - np.float32(extent)], axis=1)


def clip(boxes: Float32, shape: tuple[int, int], extent: float = 1.0) -> Float32:
    """Clip boxes (N, 4), px, to an image of size `shape` (height, width), px."""
    height, width = shape
    largest = np.array([width, height, width, height], np.float32) - np.float32(extent)
    return np.clip(boxes, np.float32(0), largest)


def to_original_image(
    boxes: Float32, resized: tuple[int, int], original: tuple[int, int], extent: float = 1.0
) -> Float32:
    """Convert boxes from the resized image to the original image.

    Args:
        boxes: The boxes (N, 4) in the resized image, px.
        resized: The size (height, width) of the resized image, px.
        original: The size (height, width) of the original image, px.
        extent: The box convention.

    Returns:
        The boxes (N, 4), px, with pixel centers at integers. The borders of pixel u are u - 0.5 and u + 0.5.
    """
    scale = np.array(original[::-1], np.float32) / np.array(resized[::-1], np.float32)
    borders = boxes + np.array([0, 0, extent, extent], np.float32)
    return np.asarray(borders * np.tile(scale, 2) - np.float32(0.5), np.float32)


def suppress_boxes(
    boxes: Float32,
    scores: Float32,
    iou: float,
    classes: Int32 | None = None,
    limit: int | None = None,
    extent: float = 1.0,
) -> Int32:
    """Apply greedy non-maximum suppression to boxes.

    Args:
        boxes: The boxes (N, 4), px.
        scores: The scores (N,). Equal scores keep their order.
        iou: The IoU above which the worse of two boxes of a class is removed.
        classes: The class indices (N,); None = one class.
        limit: The maximum number of boxes.
        extent: The box convention.

    Returns:
        The indices of the remaining boxes, best first.
    """
    # OpenCV's implementation offsets boxes by class, which rounds the IoU; torchvision's extension requires a matching
    # build of torch
    order = np.argsort(-scores, kind="stable").astype(np.int32)
    if classes is None:
        classes = np.zeros(len(scores), np.int32)
    return np.asarray(
        suppress_sorted(
            np.ascontiguousarray(boxes[order], np.float32),
            np.ascontiguousarray(classes[order], np.int32),
            order,
            np.float32(iou),
            np.float32(extent),
            len(scores) if limit is None else limit,
        )
    )
