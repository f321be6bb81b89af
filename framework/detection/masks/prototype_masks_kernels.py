"""Kernels of prototype_masks.py."""

from __future__ import annotations

import numpy as np
from numba import njit


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
def sample_prototypes(logits, borders, affine, least, masks):
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
