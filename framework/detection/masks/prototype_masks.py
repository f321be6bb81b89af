"""Masks as sums of prototypes (Bolya et al., "YOLACT", 2019): one small map for the whole image, weights by object."""

from __future__ import annotations

import math

import numpy as np

from framework.data import Bool, Float32
from framework.detection.masks.letterbox import Letterbox
from framework.detection.masks.prototype_masks_kernels import sample_prototypes


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
    sample_prototypes(
        np.ascontiguousarray(logits, np.float32), np.ascontiguousarray(borders, np.float64), affine, least, masks
    )
    return masks
