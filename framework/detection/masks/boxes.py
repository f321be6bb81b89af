"""Boxes: x1 y1 x2 y2 in pixels, and the deltas by which a network moves them.

Two conventions are in the field, and a network works only with the one that it was trained with. `extent` tells them
apart: 1 = the old one, where x2 is the last pixel inside, so that a box is x2 - x1 + 1 wide; 0 = the newer one, where
x2 is the right border.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32

LARGEST_LOG_SCALE = float(np.log(1000.0 / 16.0))  # a box grows by at most this factor, so that exp cannot overflow
"""Detectron's bound (Girshick et al., github.com/facebookresearch/Detectron)."""


def anchor_grid(anchors: Float32, rows: int, columns: int, stride: float | tuple[float, float]) -> Float32:
    """The (A, 4) anchors of cell (0, 0) repeated over a feature map: (rows * columns * A, 4), the anchor fastest.

    `stride`: px per cell, one for both axes or y and x.
    """
    stride_y, stride_x = stride if isinstance(stride, tuple) else (stride, stride)
    x, y = np.meshgrid(np.arange(columns) * stride_x, np.arange(rows) * stride_y)
    shifts = np.stack([x, y, x, y], axis=-1).reshape(-1, 1, 4)
    return np.asarray(shifts + anchors, np.float32).reshape(-1, 4)


def decode(boxes: Float32, deltas: Float32, extent: float = 1.0) -> Float32:
    """The (N, 4) boxes moved by (N, 4) deltas dx dy dw dh, relative to the boxes' centres and sizes.

    Source: Girshick et al., "Rich feature hierarchies ...", 2014, appendix C, with Detectron's pixel conventions.
    """
    sizes = boxes[:, 2:] - boxes[:, :2] + np.float32(extent)
    centers = boxes[:, :2] + sizes * np.float32(0.5)
    centers = deltas[:, :2] * sizes + centers
    sizes = sizes * np.exp(np.minimum(deltas[:, 2:], np.float32(LARGEST_LOG_SCALE)))
    half = sizes * np.float32(0.5)
    return np.concatenate([centers - half, centers + half - np.float32(extent)], axis=1)


def clip(boxes: Float32, shape: tuple[int, int], extent: float = 1.0) -> Float32:
    """The boxes (N, 4) cut at the borders of an image of `shape` (height, width)."""
    height, width = shape
    largest = np.array([width, height, width, height], np.float32) - np.float32(extent)
    return np.clip(boxes, np.float32(0), largest)


def to_original_image(
    boxes: Float32, resized: tuple[int, int], original: tuple[int, int], extent: float = 1.0
) -> Float32:
    """Boxes (N, 4) in a resized image, as borders in the image before: shapes (height, width).

    Pixel centres are at integers, so the returned borders of a box of one pixel (u, v) are u - 0.5 and u + 0.5.
    """
    scale = np.array(original[::-1], np.float32) / np.array(resized[::-1], np.float32)
    borders = boxes + np.array([0, 0, extent, extent], np.float32)
    return np.asarray(borders * np.tile(scale, 2) - np.float32(0.5), np.float32)
