"""Masks from prototypes, against the definition of bilinear interpolation, and without a half-pixel shift."""

import numpy as np
import pytest

from framework.detection.masks.letterbox import Letterbox, Placement
from framework.detection.masks.prototype_masks import masks_from_prototypes

IMAGE, INPUT, CELLS = (37, 53), (64, 64), (16, 16)


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
def test_masks_are_those_of_the_definition(placement, threshold):
    rng = np.random.default_rng(5)
    letterbox = Letterbox.fit(IMAGE, INPUT, placement)
    coefficients, prototypes = rng.normal(0, 1, (3, 4)).astype("f4"), rng.normal(0, 1, (4, *CELLS)).astype("f4")
    borders = np.array([[-3, -2, 60, 40], [10.2, 5.7, 30.5, 30.5], [20, 20, 10, 30]], np.float32)
    found = masks_from_prototypes(coefficients, prototypes, borders, letterbox, IMAGE, threshold)
    expected = slow_masks(coefficients, prototypes, borders, letterbox, IMAGE, threshold)
    assert expected[0].any()
    assert not found[2].any()
    np.testing.assert_array_equal(found, expected)


def test_a_straight_edge_comes_back_where_it_was():
    """A prototype that is linear in x of the image crosses zero at u = 20.3: the mask begins with pixel 21."""
    letterbox = Letterbox.fit((48, 48), (96, 96), Placement.center)
    cell_centers = (np.arange(24) + 0.5) * 4 / 2 - 0.5  # in px of the image
    prototypes = np.tile((cell_centers - 20.3).astype("f4"), (1, 24, 1))
    borders = np.array([[-0.5, -0.5, 47.5, 47.5]], np.float32)
    (mask,) = masks_from_prototypes(np.ones((1, 1), "f4"), prototypes, borders, letterbox, (48, 48))
    assert (mask == (np.arange(48) > 20.3)).all()


def test_no_detections():
    letterbox = Letterbox.fit(IMAGE, INPUT, Placement.center)
    none = np.zeros((0, 4), np.float32)
    masks = masks_from_prototypes(none, np.zeros((4, *CELLS), np.float32), none, letterbox, IMAGE)
    assert masks.shape == (0, *IMAGE)
