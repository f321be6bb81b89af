"""Square pictures of single objects, cut out of an image, as networks for whole pictures take them."""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import Bool, Float32, UInt8
from framework.detection.masks.binary_masks import tight_boxes

GRAY = 128


def square_crops(color: UInt8, masks: Bool, side: int, context: float, surroundings: float = 1.0) -> UInt8:
    """One picture (side, side, 4) for each of the masks (N, H, W) of the image `color` (H, W, 3): RGB, and 255 inside.

    A picture is the square around the mask's middle whose side is `context` times the longer side of the mask's box, so
    that nothing is distorted; what lies beyond the image is black. What is around the object keeps the share
    `surroundings` of its difference from gray. Shrinking averages. An empty mask gives black.
    """
    crops = np.zeros((len(masks), side, side, 4), np.uint8)
    for k, box in enumerate(tight_boxes(masks)):
        if not masks[k].any():
            continue
        with_mask = np.dstack([color, masks[k].view(np.uint8) * np.uint8(255)])
        crops[k] = _square_crop(with_mask, box, side, context, surroundings)
    return crops


def _square_crop(image: UInt8, box: Float32, side: int, context: float, surroundings: float) -> UInt8:
    """The square (side, side, 4) around a box x1 y1 x2 y2 of pixels inside, of an image whose fourth channel is 255
    on the object.
    """
    height, width = image.shape[:2]
    x1, y1, x2, y2 = (int(value) for value in box)
    wide = max(1, round(context * (max(x2 - x1, y2 - y1) + 1)))  # px
    left, top = (x1 + x2 + 1 - wide) // 2, (y1 + y2 + 1 - wide) // 2
    square = np.zeros((wide, wide, image.shape[2]), np.uint8)
    u1, v1, u2, v2 = max(left, 0), max(top, 0), min(left + wide, width), min(top + wide, height)
    square[v1 - top : v2 - top, u1 - left : u2 - left] = image[v1:v2, u1:u2]
    if surroundings < 1:
        around = square[..., 3] == 0
        square[around, :3] = np.round(GRAY + surroundings * (square[around, :3].astype(np.float32) - GRAY))
    shrinks = side < wide
    return np.asarray(cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))
