"""Kernels of boxes.py."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def suppress_sorted(boxes, classes, order, iou, extent, limit):
    """Return the entries of `order` (N,) for at most `limit` boxes that remain after non-maximum suppression.

    `boxes`: (N, 4) x1 y1 x2 y2 px, best first. `classes`: (N,). A box is removed if its IoU with an earlier remaining
    box of its class exceeds `iou`. `extent`: the box convention, see boxes.py.
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
