"""Kernels of binary_masks.py."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def mask_bounds(masks):
    """Each row is read whole first, 64 pixels at a time, as most rows are empty; then from both ends."""
    n, height, width = masks.shape
    bounds = np.zeros((n, 4), np.int64)
    for i in range(n):
        x1, y1, x2, y2 = width, height, -1, -1
        for v in range(height):
            filled = np.uint8(0)
            for u in range(width):
                filled = np.uint8(filled | masks[i, v, u])  # numba would go on in 64 bits
            if not filled:
                continue
            u = 0
            while not masks[i, v, u]:
                u += 1
            x1, y1, y2 = min(x1, u), min(y1, v), v
            u = width - 1
            while not masks[i, v, u]:
                u -= 1
            x2 = max(x2, u)
        if x2 >= 0:
            bounds[i, 0], bounds[i, 1], bounds[i, 2], bounds[i, 3] = x1, y1, x2, y2
    return bounds


@njit(cache=True, nogil=True)
def shared_pixels(masks, bounds):
    """Counts the pixels of two masks where their bounds (N, 4) meet: quick where most masks are small, and few meet."""
    n = len(masks)
    shared = np.zeros((n, n), np.int64)
    for i in range(n):
        for j in range(i, n):
            x1, y1 = max(bounds[i, 0], bounds[j, 0]), max(bounds[i, 1], bounds[j, 1])
            x2, y2 = min(bounds[i, 2], bounds[j, 2]), min(bounds[i, 3], bounds[j, 3])
            for v in range(y1, y2 + 1):
                count = np.int32(0)
                for u in range(np.uint64(x1), np.uint64(max(x2 + 1, x1))):  # what may be negative is no vector's index
                    count = np.int32(count + np.int32(masks[i, v, u] & masks[j, v, u]))  # numba would add in 64 bits
                shared[i, j] += count
            shared[j, i] = shared[i, j]
    return shared


@njit(cache=True, nogil=True)
def _axis_cells(start, end, cells, pixels):
    """Where pixels along one axis fall in a ringed grid: first pixel, then the lower cell and the weight of the upper.

    `cells` is without the ring. Only pixels within half a cell of the box or inside it can see it.
    """
    cell = (end - start) / cells  # px
    first = max(0, int(np.ceil(start - 0.5 * cell)))
    last = min(pixels - 1, int(np.floor(end + 0.5 * cell)))
    n = max(0, last - first + 1)
    lower = np.empty(n, np.int64)
    weight = np.empty(n, np.float32)
    for i in range(n):
        place = (first + i - start) / cell + 0.5  # 0 is the centre of the ring's first cell, cells + 1 of its last
        place = min(max(place, 0.0), cells + 1.0)
        lower[i] = min(int(place), cells)
        weight[i] = place - lower[i]
    return first, lower, weight


@njit(cache=True, nogil=True)
def paste(ringed, borders, threshold, masks):
    """Rows first: one blended row of the grid serves a whole row of pixels."""
    n, height, width = masks.shape
    cells = ringed.shape[1] - 2
    row = np.empty(cells + 2, np.float32)
    for i in range(n):
        x1, y1, x2, y2 = borders[i, 0], borders[i, 1], borders[i, 2], borders[i, 3]
        if not (x2 > x1 and y2 > y1):
            continue
        u0, left, u_weight = _axis_cells(x1, x2, cells, width)
        v0, above, v_weight = _axis_cells(y1, y2, cells, height)
        for j in range(len(above)):
            for c in range(cells + 2):
                row[c] = ringed[i, above[j], c] + v_weight[j] * (ringed[i, above[j] + 1, c] - ringed[i, above[j], c])
            for k in range(len(left)):
                value = row[left[k]] + u_weight[k] * (row[left[k] + 1] - row[left[k]])
                masks[i, v0 + j, u0 + k] = value > threshold
