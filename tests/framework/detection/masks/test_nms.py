"""Non-maximum suppression against the quadratic algorithm of the textbook."""

import numpy as np
import pytest

from framework.detection.masks.nms import suppress_boxes


def iou(a, b, extent):
    width = min(a[2], b[2]) - max(a[0], b[0]) + extent
    height = min(a[3], b[3]) - max(a[1], b[1]) + extent
    if width <= 0 or height <= 0:
        return 0.0
    area = [(c[2] - c[0] + extent) * (c[3] - c[1] + extent) for c in (a, b)]
    return width * height / (sum(area) - width * height)


def textbook(boxes, scores, threshold, classes, limit, extent):
    left = sorted(range(len(boxes)), key=lambda i: -scores[i])
    kept = []
    while left and len(kept) < limit:
        best = left.pop(0)
        kept.append(best)
        left = [i for i in left if classes[i] != classes[best] or iou(boxes[i], boxes[best], extent) <= threshold]
    return kept


@pytest.mark.parametrize("extent", [0.0, 1.0])
@pytest.mark.parametrize("limit", [7, 1000])
def test_agrees_with_the_textbook(extent, limit):
    rng = np.random.default_rng(2)
    corners = rng.integers(0, 60, (120, 2))
    boxes = np.hstack([corners, corners + rng.integers(5, 40, (120, 2))]).astype(np.float32)
    scores = rng.permutation(120).astype(np.float32) / 120
    classes = rng.integers(0, 3, 120).astype(np.int32)
    kept = suppress_boxes(boxes, scores, 0.3, classes, limit, extent)
    assert kept.tolist() == textbook(boxes, scores, 0.3, classes, limit, extent)


def test_classes_do_not_suppress_each_other():
    boxes = np.array([[0, 0, 9, 9], [0, 0, 9, 9], [0, 0, 9, 9]], np.float32)
    scores = np.array([0.5, 0.9, 0.7], np.float32)
    assert suppress_boxes(boxes, scores, 0.5).tolist() == [1]
    assert suppress_boxes(boxes, scores, 0.5, np.array([0, 0, 1], np.int32)).tolist() == [1, 2]


def test_ties_keep_the_order_of_the_input_and_nothing_gives_nothing():
    boxes = np.array([[0, 0, 9, 9], [1, 0, 9, 9]], np.float32)
    assert suppress_boxes(boxes, np.full(2, 0.5, np.float32), 0.5).tolist() == [0]
    assert suppress_boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), 0.5).shape == (0,)
