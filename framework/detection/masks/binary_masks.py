"""Masks of objects: from a network's small grid to the image, and the boxes around them."""

from __future__ import annotations

import numpy as np
from numba import njit

from framework.data import Bool, Detections, Float32, Float64, Int32


def paste_masks(grids: Float32, borders: Float32, shape: tuple[int, int], threshold: float = 0.5) -> Bool:
    """The masks (N, H, W) of an image of `shape` (height, width) where bilinearly resized grids exceed `threshold`.

    grids (N, G, G) probabilities over each box; borders (N, 4) x1 y1 x2 y2 of the boxes in px with pixel centres at
    integers. Around a grid there is a ring of zero cells, as in Detectron, so that an object that fills its box ends at
    the box, and not at the centre of the last cell.
    """
    ringed = np.pad(grids.astype(np.float32, copy=False), ((0, 0), (1, 1), (1, 1)))
    masks = np.zeros((len(grids), *shape), np.bool_)
    _paste(ringed, np.ascontiguousarray(borders, np.float64), np.float32(threshold), masks)
    return masks


def tight_boxes(masks: Bool) -> Float32:
    """The (N, 4) boxes x1 y1 x2 y2 px of masks (N, H, W): first and last column and row inside; 0 for an empty mask."""
    return np.asarray(_bounds(masks.view(np.uint8)), np.float32)


def mask_overlaps(masks: Bool, boxes: Float32) -> Float64:
    """The (N, N) numbers of pixels that masks (N, H, W) share; on the diagonal their areas.

    boxes (N, 4) are `tight_boxes` of the masks, which is not checked.
    """
    return np.asarray(_shared(masks.view(np.uint8), boxes.astype(np.int64)), np.float64)


def suppress_duplicates(masks: Bool, boxes: Float32, iou: float) -> Int32:
    """The indices of the masks (N, H, W), best first, that are not empty and overlap no better survivor by `iou`.

    boxes (N, 4) are the masks' tight ones.
    """
    overlaps = mask_overlaps(masks, boxes)
    areas = overlaps.diagonal()
    covered = overlaps > iou * (areas[:, None] + areas - overlaps)
    survives = areas > 0
    for i in range(1, len(masks)):
        survives[i] &= not (covered[i, :i] & survives[:i]).any()
    return np.flatnonzero(survives).astype(np.int32)


def without_duplicates(
    masks: Bool, scores: Float32, class_probabilities: Float32, classes: tuple[str, ...], iou: float
) -> Detections:
    """The detections, best first, whose masks (N, H, W) `suppress_duplicates` leaves, in tight boxes."""
    boxes = tight_boxes(masks)
    kept = suppress_duplicates(masks, boxes, iou)
    return Detections(masks[kept], boxes[kept], scores[kept], class_probabilities[kept], classes)


@njit(cache=True, nogil=True)
def _bounds(masks):
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
def _shared(masks, bounds):
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
def _paste(ringed, borders, threshold, masks):
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
