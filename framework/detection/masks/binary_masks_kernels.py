"""Kernels of binary_masks.py, and detection of touching instances."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit

CONTACT_DEPTH = 0.1  # largest difference in depth between neighboring pixels of two touching instances, m


@njit(cache=True, nogil=True)
def mask_bounds(masks):
    """Return the bounding boxes (N, 4) x1 y1 x2 y2, px, of masks (N, H, W).

    The box of an empty mask is 0.
    """
    n, height, width = masks.shape
    bounds = np.zeros((n, 4), np.int64)
    for i in range(n):
        x1, y1, x2, y2 = width, height, -1, -1
        for v in range(height):
            filled = np.uint8(0)  # a vectorized test skips empty rows, because most rows are empty
            for u in range(width):
                filled = np.uint8(filled | masks[i, v, u])  # numba would widen to 64 bits
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
    """Return the number of common pixels (N, N) for each pair of masks (N, H, W).

    `bounds` are the bounding boxes (N, 4) from `mask_bounds`.
    """
    n = len(masks)
    shared = np.zeros((n, n), np.int64)
    for i in range(n):
        for j in range(i, n):
            x1, y1 = max(bounds[i, 0], bounds[j, 0]), max(bounds[i, 1], bounds[j, 1])
            x2, y2 = min(bounds[i, 2], bounds[j, 2]), min(bounds[i, 3], bounds[j, 3])
            for v in range(y1, y2 + 1):
                count = np.int32(0)
                for u in range(np.uint64(x1), np.uint64(max(x2 + 1, x1))):  # a signed index prevents vectorization
                    count = np.int32(count + np.int32(masks[i, v, u] & masks[j, v, u]))  # numba would add in 64 bits
                shared[i, j] += count
            shared[j, i] = shared[i, j]
    return shared


@njit(cache=True, nogil=True)
def _grid_cells(start, end, cells, pixels):
    """Return the pixels of a box along one axis and the grid cells between which they are interpolated.

    Args:
        start: The first border of the box, px.
        end: The second border of the box, px.
        cells: The number of grid cells without the padding. Index 0 is the padding.
        pixels: The size of the image, px.

    Returns:
        The first pixel, and for each pixel the index of the lower cell and the weight of the next cell.
    """
    cell = (end - start) / cells  # px
    first = max(0, int(np.ceil(start - 0.5 * cell)))
    last = min(pixels - 1, int(np.floor(end + 0.5 * cell)))
    n = max(0, last - first + 1)
    lower = np.empty(n, np.int64)
    weight = np.empty(n, np.float32)
    for i in range(n):
        position = (first + i - start) / cell + 0.5  # cells; the centers of the padding are at 0 and cells + 1
        position = min(max(position, 0.0), cells + 1.0)
        lower[i] = min(int(position), cells)
        weight[i] = position - lower[i]
    return first, lower, weight


@njit(cache=True, nogil=True)
def paste(padded, borders, threshold, masks):
    """Resample grids of probabilities to the boxes of an image.

    Args:
        padded: The probabilities (N, G + 2, G + 2), padded with zeros.
        borders: The boxes (N, 4) x1 y1 x2 y2, px.
        threshold: The minimum probability of a pixel in the mask.
        masks: The output masks (N, H, W), initially False.
    """
    n, height, width = masks.shape
    cells = padded.shape[1] - 2
    row = np.empty(cells + 2, np.float32)
    for i in range(n):
        x1, y1, x2, y2 = borders[i, 0], borders[i, 1], borders[i, 2], borders[i, 3]
        if not (x2 > x1 and y2 > y1):
            continue
        u0, left, u_weight = _grid_cells(x1, x2, cells, width)
        v0, above, v_weight = _grid_cells(y1, y2, cells, height)
        for j in range(len(above)):
            for c in range(cells + 2):
                row[c] = padded[i, above[j], c] + v_weight[j] * (padded[i, above[j] + 1, c] - padded[i, above[j], c])
            for k in range(len(left)):
                value = row[left[k]] + u_weight[k] * (row[left[k] + 1] - row[left[k]])
                masks[i, v0 + j, u0 + k] = value > threshold


@njit(cache=True, nogil=True)
def _prototype_cells(start, end, pixels, scale, shift, cells):
    """Return the pixels of a box along one axis and the cells between which they are interpolated.

    Args:
        start: The first border of the box, px.
        end: The second border of the box, px.
        pixels: The size of the image, px.
        scale: The number of cells per pixel.
        shift: The cell coordinate of pixel 0.
        cells: The number of cells.

    Returns:
        The first pixel, and for each pixel the index of the lower cell and the weight of the next cell.
    """
    first, stop = max(0, int(np.ceil(start))), min(pixels, int(np.ceil(end)))
    n = max(0, stop - first)
    lower = np.empty(n, np.int64)
    weight = np.empty(n, np.float32)
    for i in range(n):
        position = min(max((first + i) * scale + shift, 0.0), cells - 1.0)
        lower[i] = min(int(position), max(cells - 2, 0))
        weight[i] = position - lower[i]
    return first, lower, weight


@njit(cache=True, nogil=True)
def sample_prototypes(logits, borders, affine, least, masks):
    """Write the masks of boxes from interpolated logits.

    Args:
        logits: The logits (N, h, w).
        borders: The boxes (N, 4) x1 y1 x2 y2, px.
        affine: The scale and shift (2, 2) from pixels to cells, along x and y.
        least: The minimum logit of a pixel in the mask.
        masks: The output masks (N, H, W), initially False.
    """
    n, height, width = masks.shape
    rows, columns = logits.shape[1:]
    for i in range(n):
        x1, y1, x2, y2 = borders[i]
        u0, left, u_weight = _prototype_cells(x1, x2, width, affine[0, 0], affine[0, 1], columns)
        v0, above, v_weight = _prototype_cells(y1, y2, height, affine[1, 0], affine[1, 1], rows)
        for j in range(len(above)):
            upper, under = logits[i, above[j]], logits[i, min(above[j] + 1, rows - 1)]
            row = upper + v_weight[j] * (under - upper)
            for k in range(len(left)):
                low, high = row[left[k]], row[min(left[k] + 1, columns - 1)]
                masks[i, v0 + j, u0 + k] = low + u_weight[k] * (high - low) > least


@njit(cache=True, nogil=True)
def contacts(ids, depth):
    """Return the pairs (M, 2) of ids of touching instances, possibly with repetitions.

    Instances touch if they have neighboring pixels whose depths differ by less than CONTACT_DEPTH. The smaller id of a
    pair is first.

    Args:
        ids: The instance ids (H, W), 0 or negative = no instance.
        depth: The depth (H, W), m.
    """
    height, width = ids.shape
    pairs = np.empty((2 * height * width, 2), np.int32)
    n = 0
    for v in range(height):
        for u in range(width):
            own = ids[v, u]
            if own <= 0:
                continue
            for y, x in ((v, u + 1), (v + 1, u)):
                if y == height or x == width or ids[y, x] <= 0 or ids[y, x] == own:
                    continue
                if abs(depth[v, u] - depth[y, x]) < np.float32(CONTACT_DEPTH):
                    pairs[n, 0], pairs[n, 1] = min(own, ids[y, x]), max(own, ids[y, x])
                    n += 1
    return pairs[:n].copy()
