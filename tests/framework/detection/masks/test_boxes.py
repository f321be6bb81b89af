"""Box arithmetic against the formulas, written out for one box."""

import math

import numpy as np
import pytest

from framework.detection.masks.boxes import LARGEST_LOG_SCALE, anchor_grid, clip, decode, to_original_image


def decode_one(box, delta, extent):
    x1, y1, x2, y2 = box
    dx, dy, dw, dh = delta
    w, h = x2 - x1 + extent, y2 - y1 + extent
    pcx, pcy = dx * w + x1 + w / 2, dy * h + y1 + h / 2
    pw, ph = w * math.exp(min(dw, LARGEST_LOG_SCALE)), h * math.exp(min(dh, LARGEST_LOG_SCALE))
    return pcx - pw / 2, pcy - ph / 2, pcx + pw / 2 - extent, pcy + ph / 2 - extent


@pytest.mark.parametrize("extent", [0.0, 1.0])
def test_decode_agrees_with_the_formula(extent):
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 200, (50, 2))
    boxes = np.hstack([corners, corners + rng.uniform(1, 100, (50, 2))]).astype(np.float32)
    deltas = rng.normal(0, 0.5, (50, 4)).astype(np.float32)
    expected = [decode_one(box, delta, extent) for box, delta in zip(boxes, deltas, strict=True)]
    np.testing.assert_allclose(decode(boxes, deltas, extent), expected, rtol=1e-4, atol=1e-3)


def test_zero_deltas_move_nothing_and_huge_ones_stay_finite():
    box = np.array([[10, 20, 29, 59]], np.float32)
    np.testing.assert_allclose(decode(box, np.zeros((1, 4), np.float32)), box)
    huge = decode(box, np.full((1, 4), 1000, np.float32))
    assert np.isfinite(huge).all()
    assert huge[0, 2] - huge[0, 0] + 1 == pytest.approx(20 * 1000 / 16, rel=1e-4)


def test_clip_keeps_to_the_last_pixel_in_the_old_convention_and_to_the_border_in_the_new():
    box = np.array([[-5, -6, 700, 800]], np.float32)
    np.testing.assert_array_equal(clip(box, (480, 640), extent=1), [[0, 0, 639, 479]])
    np.testing.assert_array_equal(clip(box, (480, 640), extent=0), [[0, 0, 640, 480]])


def test_anchor_grid_runs_over_rows_then_columns_then_anchors():
    anchors = np.array([[-8, -8, 8, 8], [-16, -4, 16, 4]], np.float32)
    grid = anchor_grid(anchors, rows=2, columns=3, stride=16)
    assert grid.shape == (12, 4)
    np.testing.assert_array_equal(grid.reshape(2, 3, 2, 4)[1, 2, 1], anchors[1] + [32, 16, 32, 16])


def test_a_box_of_one_resized_pixel_covers_its_pixels_of_the_original_image():
    borders = to_original_image(np.array([[3, 5, 3, 5]], np.float32), resized=(240, 320), original=(480, 640))
    np.testing.assert_allclose(borders, [[5.5, 9.5, 7.5, 11.5]])  # columns 6 and 7, rows 10 and 11
    same = np.array([[3, 5, 4, 6]], np.float32)  # in the newer convention
    np.testing.assert_allclose(to_original_image(same, (240, 320), (480, 640), extent=0.0), borders)


def test_anchors_may_be_spaced_otherwise_along_y():
    anchors = np.array([[-8, -8, 8, 8]], np.float32)
    grid = anchor_grid(anchors, rows=2, columns=2, stride=(61, 64))
    np.testing.assert_array_equal(grid[3], anchors[0] + [64, 61, 64, 61])
