"""Greedy non-maximum suppression.

Hand-written, for OpenCV's moves the boxes to tell classes apart, which rounds their IoU, and torchvision's extension
loads only beside its own build of torch.
"""

from __future__ import annotations

import numpy as np

from framework.data import Float32, Int32
from framework.detection.masks.nms_kernels import suppress_sorted


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
        suppress_sorted(
            np.ascontiguousarray(boxes[order], np.float32),
            np.ascontiguousarray(classes[order], np.int32),
            order,
            np.float32(iou),
            np.float32(extent),
            len(scores) if limit is None else limit,
        )
    )
