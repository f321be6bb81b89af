"""Kernels of boxes.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit


@njit(cache=True, nogil=True)
def suppress_sorted(boxes, classes, order, iou, extent, limit):
    """Apply greedy non-maximum suppression to boxes that are sorted by score.

    Args:
        boxes: The boxes (N, 4) x1 y1 x2 y2, px, best first.
        classes: The class indices (N,).
        order: The values (N,) to return for the boxes.
        iou: The IoU above which the worse of two boxes of a class is removed.
        extent: The box convention, see boxes.py.
        limit: The maximum number of boxes.

    Returns:
        The values of `order` for the remaining boxes.
    """
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
