"""Masks: pasting against interpolation of every pixel, boxes and overlaps against counting."""

import numpy as np
import pytest

from framework.detection.masks.binary_masks import mask_overlaps, paste_masks, suppress_duplicates, tight_boxes


def paste_by_pixel(grid, borders, shape, threshold):
    cells = len(grid)
    ringed = np.pad(grid, 1)
    x1, y1, x2, y2 = borders
    mask = np.zeros(shape, bool)
    for v in range(shape[0]):
        for u in range(shape[1]):
            a, b = (v - y1) / (y2 - y1) * cells + 0.5, (u - x1) / (x2 - x1) * cells + 0.5
            if not (0 <= a < cells + 1 and 0 <= b < cells + 1):
                continue
            i, j = int(a), int(b)
            p, q = a - i, b - j
            value = (1 - p) * ((1 - q) * ringed[i, j] + q * ringed[i, j + 1])
            value += p * ((1 - q) * ringed[i + 1, j] + q * ringed[i + 1, j + 1])
            mask[v, u] = value > threshold
    return mask


@pytest.mark.parametrize(
    "borders",
    [(5.2, 3.1, 44.7, 30.3), (-20, -10, 25, 60), (10.4, 10.4, 11.1, 12.3), (30, 5, 400, 38), (-50, -50, -9, -9)],
)
def test_pasting_agrees_with_interpolating_every_pixel(borders):
    rng = np.random.default_rng(4)
    grid = rng.uniform(0, 1, (24, 24)).astype(np.float32)
    (mask,) = paste_masks(grid[None], np.array([borders], np.float32), (40, 60), 0.5)
    expected = paste_by_pixel(grid, np.float64(np.float32(borders)), (40, 60), 0.5)
    assert (mask != expected).sum() <= 2  # float32 against float64, at the threshold itself


def test_a_full_grid_gives_exactly_its_box():
    """A cell of 1 beside the ring's 0 crosses 0.5 right at the box's border."""
    (mask,) = paste_masks(np.ones((1, 24, 24), np.float32), np.array([[9.5, 4.5, 33.5, 28.5]], np.float32), (40, 60))
    expected = np.zeros((40, 60), bool)
    expected[5:29, 10:34] = True
    np.testing.assert_array_equal(mask, expected)


def test_degenerate_boxes_paste_nothing():
    borders = np.array([[5, 5, 5, 9], [9, 5, 5, 9]], np.float32)
    assert not paste_masks(np.ones((2, 8, 8), np.float32), borders, (20, 20)).any()
    assert paste_masks(np.ones((0, 8, 8), np.float32), np.zeros((0, 4), np.float32), (20, 20)).shape == (0, 20, 20)


def test_tight_boxes_are_the_first_and_last_pixels():
    rng = np.random.default_rng(5)
    masks = rng.random((20, 31, 47)) > 0.995
    masks[3] = False
    masks[4] = True
    for mask, box in zip(masks, tight_boxes(masks), strict=True):
        v, u = np.nonzero(mask)
        assert box.tolist() == ([u.min(), v.min(), u.max(), v.max()] if len(u) else [0, 0, 0, 0])


def test_overlaps_count_shared_pixels():
    """Of masks that fill the image, lie in a corner of it, meet in a row or column, or are empty."""
    rng = np.random.default_rng(6)
    masks = rng.random((12, 40, 300)) > 0.5
    for mask in masks[2:]:
        (v1, v2), (u1, u2) = (np.sort(rng.integers(0, side + 1, 2)) for side in mask.shape)
        mask[:v1], mask[v2:], mask[:, :u1], mask[:, u2:] = False, False, False, False
    masks[2] = False
    masks[3], masks[4] = False, False
    masks[3, :21, :101], masks[4, 20:, 100:] = True, True
    flat = masks.reshape(len(masks), -1).astype(int)
    np.testing.assert_array_equal(mask_overlaps(masks, tight_boxes(masks)), flat @ flat.T)
    assert mask_overlaps(masks[:0], tight_boxes(masks[:0])).shape == (0, 0)


def test_duplicates_fall_to_the_first_survivor_and_empty_masks_go():
    masks = np.zeros((5, 10, 10), bool)
    masks[0, :, :6] = True
    masks[1, :, :7] = True  # IoU 6/7 with 0
    masks[2, :, 1:8] = True  # IoU 5/8 with 0 and 6/8 with 1, which is gone
    masks[4, 8:, 8:] = True
    boxes = tight_boxes(masks)
    assert suppress_duplicates(masks, boxes, 0.7).tolist() == [0, 2, 4]
    assert suppress_duplicates(masks, boxes, 1.0).tolist() == [0, 1, 2, 4]
