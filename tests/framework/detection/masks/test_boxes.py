"""Tests for box operations and non-maximum suppression."""

import math

import numpy as np
import pytest

from framework.detection.masks.boxes import (
    LARGEST_LOG_SCALE,
    anchor_grid,
    clip,
    decode,
    suppress_boxes,
    to_original_image,
)


def decode_one(box, delta, extent):
    x1, y1, x2, y2 = box
    dx, dy, dw, dh = delta
    w, h = x2 - x1 + extent, y2 - y1 + extent
    pcx, pcy = dx * w + x1 + w / 2, dy * h + y1 + h / 2
    pw, ph = w * math.exp(min(dw, LARGEST_LOG_SCALE)), h * math.exp(min(dh, LARGEST_LOG_SCALE))
    return pcx - pw / 2, pcy - ph / 2, pcx + pw / 2 - extent, pcy + ph / 2 - extent


@pytest.mark.parametrize("extent", [0.0, 1.0])
def test_box_decode_matches_formula(extent):
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 200, (50, 2))
    boxes = np.hstack([corners, corners + rng.uniform(1, 100, (50, 2))]).astype(np.float32)
    deltas = rng.normal(0, 0.5, (50, 4)).astype(np.float32)
    expected = [decode_one(box, delta, extent) for box, delta in zip(boxes, deltas, strict=True)]
    np.testing.assert_allclose(decode(boxes, deltas, extent), expected, rtol=1e-4, atol=1e-3)


ANCHOR = np.array([[10, 20, 29, 59]], np.float32)


def test_box_decode_zero_deltas_give_anchor():
    np.testing.assert_allclose(decode(ANCHOR, np.zeros((1, 4), np.float32)), ANCHOR)


def test_box_decode_huge_deltas_stay_finite():
    huge = decode(ANCHOR, np.full((1, 4), 1000, np.float32))
    assert np.isfinite(huge).all()
    assert huge[0, 2] - huge[0, 0] + 1 == pytest.approx(20 * 1000 / 16, rel=1e-4)


def test_clip_extent_selects_last_pixel_or_border():
    box = np.array([[-5, -6, 700, 800]], np.float32)
    np.testing.assert_array_equal(clip(box, (480, 640), extent=1), [[0, 0, 639, 479]])
    np.testing.assert_array_equal(clip(box, (480, 640), extent=0), [[0, 0, 640, 480]])


def test_anchor_grid_order_is_rows_columns_anchors():
    anchors = np.array([[-8, -8, 8, 8], [-16, -4, 16, 4]], np.float32)
    grid = anchor_grid(anchors, rows=2, columns=3, stride=16)
    assert grid.shape == (12, 4)
    np.testing.assert_array_equal(grid.reshape(2, 3, 2, 4)[1, 2, 1], anchors[1] + [32, 16, 32, 16])


def test_to_original_image_maps_pixel_box_exactly():
    borders = to_original_image(np.array([[3, 5, 3, 5]], np.float32), resized=(240, 320), original=(480, 640))
    np.testing.assert_allclose(borders, [[5.5, 9.5, 7.5, 11.5]])  # columns 6 and 7, rows 10 and 11
    same = np.array([[3, 5, 4, 6]], np.float32)  # the same box in the convention with extent 0
    np.testing.assert_allclose(to_original_image(same, (240, 320), (480, 640), extent=0.0), borders)


def test_anchor_grid_accepts_separate_strides_per_axis():
    anchors = np.array([[-8, -8, 8, 8]], np.float32)
    grid = anchor_grid(anchors, rows=2, columns=2, stride=(61, 64))
    np.testing.assert_array_equal(grid[3], anchors[0] + [64, 61, 64, 61])


def iou(a, b, extent):
    width = min(a[2], b[2]) - max(a[0], b[0]) + extent
    height = min(a[3], b[3]) - max(a[1], b[1]) + extent
    if width <= 0 or height <= 0:
        return 0.0
    area = [(c[2] - c[0] + extent) * (c[3] - c[1] + extent) for c in (a, b)]
    return width * height / (sum(area) - width * height)


def reference_nms(boxes, scores, threshold, classes, limit, extent):
    left = sorted(range(len(boxes)), key=lambda i: -scores[i])
    kept = []
    while left and len(kept) < limit:
        best = left.pop(0)
        kept.append(best)
        left = [i for i in left if classes[i] != classes[best] or iou(boxes[i], boxes[best], extent) <= threshold]
    return kept


@pytest.mark.parametrize("extent", [0.0, 1.0])
@pytest.mark.parametrize("limit", [7, 1000])
def test_suppress_boxes_matches_quadratic_algorithm(extent, limit):
    rng = np.random.default_rng(2)
    corners = rng.integers(0, 60, (120, 2))
    boxes = np.hstack([corners, corners + rng.integers(5, 40, (120, 2))]).astype(np.float32)
    scores = rng.permutation(120).astype(np.float32) / 120
    classes = rng.integers(0, 3, 120).astype(np.int32)
    kept = suppress_boxes(boxes, scores, 0.3, classes, limit, extent)
    assert kept.tolist() == reference_nms(boxes, scores, 0.3, classes, limit, extent)


def test_suppress_boxes_keeps_boxes_of_other_classes():
    boxes = np.array([[0, 0, 9, 9], [0, 0, 9, 9], [0, 0, 9, 9]], np.float32)
    scores = np.array([0.5, 0.9, 0.7], np.float32)
    assert suppress_boxes(boxes, scores, 0.5).tolist() == [1]
    assert suppress_boxes(boxes, scores, 0.5, np.array([0, 0, 1], np.int32)).tolist() == [1, 2]


def test_suppress_boxes_keeps_input_order_of_ties():
    boxes = np.array([[0, 0, 9, 9], [1, 0, 9, 9]], np.float32)
    assert suppress_boxes(boxes, np.full(2, 0.5, np.float32), 0.5).tolist() == [0]
    assert suppress_boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), 0.5).shape == (0,)
