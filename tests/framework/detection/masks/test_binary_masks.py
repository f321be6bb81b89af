"""Tests for binary masks, compared with per-pixel references."""

import numpy as np
import pytest

from framework.detection.masks.binary_masks import (
    mask_overlaps,
    masks_from_prototypes,
    paste_masks,
    suppress_duplicates,
    tight_boxes,
)
from framework.detection.masks.letterbox import Letterbox, Placement

IMAGE, INPUT, CELLS = (37, 53), (64, 64), (16, 16)


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
def test_paste_masks_matches_per_pixel_interpolation(borders):
    rng = np.random.default_rng(4)
    grid = rng.uniform(0, 1, (24, 24)).astype(np.float32)
    (mask,) = paste_masks(grid[None], np.array([borders], np.float32), (40, 60), 0.5)
    expected = paste_by_pixel(grid, np.float64(np.float32(borders)), (40, 60), 0.5)
    assert (mask != expected).sum() <= 2  # at the threshold, float32 and float64 can differ


def test_paste_masks_full_grid_fills_box_exactly():
    """The mask interpolates between 1 in the outer cells and 0 outside, and is 0.5 at the border of the box."""
    (mask,) = paste_masks(np.ones((1, 24, 24), np.float32), np.array([[9.5, 4.5, 33.5, 28.5]], np.float32), (40, 60))
    expected = np.zeros((40, 60), bool)
    expected[5:29, 10:34] = True
    np.testing.assert_array_equal(mask, expected)


def test_paste_masks_degenerate_boxes_are_empty():
    borders = np.array([[5, 5, 5, 9], [9, 5, 5, 9]], np.float32)
    assert not paste_masks(np.ones((2, 8, 8), np.float32), borders, (20, 20)).any()
    assert paste_masks(np.ones((0, 8, 8), np.float32), np.zeros((0, 4), np.float32), (20, 20)).shape == (0, 20, 20)


def test_tight_boxes_span_first_to_last_pixel():
    rng = np.random.default_rng(5)
    masks = rng.random((20, 31, 47)) > 0.995
    masks[3] = False
    masks[4] = True
    for mask, box in zip(masks, tight_boxes(masks), strict=True):
        v, u = np.nonzero(mask)
        assert box.tolist() == ([u.min(), v.min(), u.max(), v.max()] if len(u) else [0, 0, 0, 0])


def test_mask_overlaps_count_shared_pixels():
    """Some masks fill the image or a rectangle, two share a single pixel, and one is empty."""
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


def test_suppress_duplicates_drops_duplicates_and_empty_masks():
    masks = np.zeros((5, 10, 10), bool)
    masks[0, :, :6] = True
    masks[1, :, :7] = True  # IoU 6/7 with 0
    masks[2, :, 1:8] = True  # IoU 5/8 with 0 and 6/8 with 1, which was removed
    masks[4, 8:, 8:] = True
    boxes = tight_boxes(masks)
    assert suppress_duplicates(masks, boxes, 0.7).tolist() == [0, 2, 4]
    assert suppress_duplicates(masks, boxes, 1.0).tolist() == [0, 1, 2, 4]


def slow_masks(coefficients, prototypes, borders, letterbox, shape, threshold):
    rows, columns = prototypes.shape[1:]
    masks = np.zeros((len(coefficients), *shape), bool)
    for n, v, u in np.ndindex(*masks.shape):
        x1, y1, x2, y2 = borders[n]
        if not (x1 <= u < x2 and y1 <= v < y2):
            continue
        x = ((u + 0.5) * letterbox.scale_x + letterbox.left) * columns / letterbox.input_shape[1] - 0.5
        y = ((v + 0.5) * letterbox.scale_y + letterbox.top) * rows / letterbox.input_shape[0] - 0.5
        x, y = np.clip(x, 0, columns - 1), np.clip(y, 0, rows - 1)
        logits = np.tensordot(coefficients[n].astype(float), prototypes.astype(float), 1)
        i, j = int(y), int(x)
        i1, j1 = min(i + 1, rows - 1), min(j + 1, columns - 1)
        value = (1 - y + i) * ((1 - x + j) * logits[i, j] + (x - j) * logits[i, j1])
        value += (y - i) * ((1 - x + j) * logits[i1, j] + (x - j) * logits[i1, j1])
        masks[n, v, u] = 1 / (1 + np.exp(-value)) > threshold
    return masks


@pytest.mark.parametrize("placement", Placement)
@pytest.mark.parametrize("threshold", [0.5, 0.3])
def test_masks_from_prototypes_match_definition(placement, threshold):
    rng = np.random.default_rng(5)
    letterbox = Letterbox.fit(IMAGE, INPUT, placement)
    coefficients, prototypes = rng.normal(0, 1, (3, 4)).astype("f4"), rng.normal(0, 1, (4, *CELLS)).astype("f4")
    borders = np.array([[-3, -2, 60, 40], [10.2, 5.7, 30.5, 30.5], [20, 20, 10, 30]], np.float32)
    found = masks_from_prototypes(coefficients, prototypes, borders, letterbox, IMAGE, threshold)
    expected = slow_masks(coefficients, prototypes, borders, letterbox, IMAGE, threshold)
    assert expected[0].any()
    assert not found[2].any()
    np.testing.assert_array_equal(found, expected)


def test_masks_from_prototypes_keep_edge_position():
    """The prototype is linear in x and is zero at u = 20.3 px."""
    letterbox = Letterbox.fit((48, 48), (96, 96), Placement.center)
    cell_centers = (np.arange(24) + 0.5) * 4 / 2 - 0.5  # px of the image
    prototypes = np.tile((cell_centers - 20.3).astype("f4"), (1, 24, 1))
    borders = np.array([[-0.5, -0.5, 47.5, 47.5]], np.float32)
    (mask,) = masks_from_prototypes(np.ones((1, 1), "f4"), prototypes, borders, letterbox, (48, 48))
    assert (mask == (np.arange(48) > 20.3)).all()


def test_masks_from_prototypes_without_detections_are_empty():
    letterbox = Letterbox.fit(IMAGE, INPUT, Placement.center)
    none = np.zeros((0, 4), np.float32)
    masks = masks_from_prototypes(none, np.zeros((4, *CELLS), np.float32), none, letterbox, IMAGE)
    assert masks.shape == (0, *IMAGE)
