"""Masks as sums of prototypes (Bolya et al., "YOLACT", 2019): one small map for the whole image, weights by object."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from framework.data import Bool, Float32
from framework.detection.masks.letterbox import Letterbox


def masks_from_prototypes(
    coefficients: Float32,
    prototypes: Float32,
    borders: Float32,
    letterbox: Letterbox,
    shape: tuple[int, int],
    threshold: float = 0.5,
) -> Bool:
    """The masks (N, H, W) of an image of `shape` (height, width) where the weighted prototypes exceed `threshold`.

    coefficients (N, M); prototypes (M, h, w), cells that cover the network's whole input; borders (N, 4) x1 y1 x2 y2
    of the boxes px in the image with centres at integers: a mask ends at its box. The sums are logits; they are
    interpolated bilinearly between the centres of the cells, and only then compared.
    """
    count, rows, columns = prototypes.shape
    logits = (coefficients @ prototypes.reshape(count, -1)).reshape(len(coefficients), rows, columns)
    cells_y, cells_x = rows / letterbox.input_shape[0], columns / letterbox.input_shape[1]  # cells per px of the input
    # the cell of pixel u is ((u + 0.5) scale + left) cells - 0.5: centres fall on centres
    affine = np.array(
        [
            [letterbox.scale_x * cells_x, (0.5 * letterbox.scale_x + letterbox.left) * cells_x - 0.5],
            [letterbox.scale_y * cells_y, (0.5 * letterbox.scale_y + letterbox.top) * cells_y - 0.5],
        ]
    )
    masks = np.zeros((len(coefficients), *shape), np.bool_)
    least = np.float32(math.log(threshold / (1 - threshold)))
    _sample(np.ascontiguousarray(logits, np.float32), np.ascontiguousarray(borders, np.float64), affine, least, masks)
    return masks


@njit(cache=True, nogil=True)
def _axis_cells(start, end, pixels, scale, shift, cells):
    """The first pixel inside a box along one axis; of each pixel inside the lower cell, and the upper one's weight."""
    first, stop = max(0, int(np.ceil(start))), min(pixels, int(np.ceil(end)))
    n = max(0, stop - first)
    lower = np.empty(n, np.int64)
    weight = np.empty(n, np.float32)
    for i in range(n):
        place = min(max((first + i) * scale + shift, 0.0), cells - 1.0)
        lower[i] = min(int(place), max(cells - 2, 0))
        weight[i] = place - lower[i]
    return first, lower, weight


@njit(cache=True, nogil=True)
def _sample(logits, borders, affine, least, masks):
    """Rows first: one blended row of cells serves a whole row of pixels."""
    n, height, width = masks.shape
    rows, columns = logits.shape[1:]
    for i in range(n):
        x1, y1, x2, y2 = borders[i]
        u0, left, u_weight = _axis_cells(x1, x2, width, affine[0, 0], affine[0, 1], columns)
        v0, above, v_weight = _axis_cells(y1, y2, height, affine[1, 0], affine[1, 1], rows)
        for j in range(len(above)):
            upper, under = logits[i, above[j]], logits[i, min(above[j] + 1, rows - 1)]
            row = upper + v_weight[j] * (under - upper)
            for k in range(len(left)):
                low, high = row[left[k]], row[min(left[k] + 1, columns - 1)]
                masks[i, v0 + j, u0 + k] = low + u_weight[k] * (high - low) > least
