"""Greedy non-maximum suppression.

Hand-written, for OpenCV's moves the boxes to tell classes apart, which rounds their IoU, and torchvision's extension
loads only beside its own build of torch.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Float32, Int32


def suppress_boxes(
    boxes: Float32,
    scores: Float32,
    iou: float,
    classes: Int32 | None = None,
    limit: int | None = None,
    extent: float = 1.0,
) -> Int32:
    """The indices of the boxes that no better one covers, best first, ties in the order of the input.

    boxes (N, 4) px; scores (N,). A box falls to a better, surviving one of its class when their IoU is above `iou`.
    Without `classes` (N,), all boxes are of one class. At most `limit` boxes survive. `extent`: see
    `framework.detection.masks.boxes`.
    """
    order = np.argsort(-scores, kind="stable").astype(np.int32)
    if classes is None:
        classes = np.zeros(len(scores), np.int32)
    return np.asarray(
        _suppress_sorted(
            np.ascontiguousarray(boxes[order], np.float32),
            np.ascontiguousarray(classes[order], np.int32),
            order,
            np.float32(iou),
            np.float32(extent),
            len(scores) if limit is None else limit,
        )
    )


@njit(cache=True, nogil=True)
def _suppress_sorted(boxes, classes, order, iou, extent, limit):
    """Compares each box with the survivors only: the limit makes that far fewer than all pairs."""
    survivors = np.empty(min(limit, len(boxes)), np.int32)
    n = 0
    for i in range(len(boxes)):
        if n == limit:
            break
        x1, y1, x2, y2 = boxes[i]
        area = (x2 - x1 + extent) * (y2 - y1 + extent)
        survives = True
        for k in range(n):
            j = survivors[k]
            if classes[i] != classes[j]:
                continue
            width = min(x2, boxes[j, 2]) - max(x1, boxes[j, 0]) + extent
            height = min(y2, boxes[j, 3]) - max(y1, boxes[j, 1]) + extent
            if width <= 0 or height <= 0:
                continue
            intersection = width * height
            other = (boxes[j, 2] - boxes[j, 0] + extent) * (boxes[j, 3] - boxes[j, 1] + extent)
            if intersection > iou * (area + other - intersection):
                survives = False
                break
        if survives:
            survivors[n] = i
            n += 1
    return order[survivors[:n]]
