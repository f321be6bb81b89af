"""Kernels of masks_from_boxes.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.sensors.noise_models_kernels import axial_sigma

BIN = 0.02  # width of a bin of log depth: 2% of the depth
NEAREST, FARTHEST = 0.05, 100.0  # m, range of the histogram
VALLEY = 0.15  # fraction of a mode's peak below which a bin can end the mode
SIGMAS = 3.0  # depth step that noise may cause, in standard deviations


@njit(cache=True, nogil=True)
def fill_masks(borders, windows, depth, significance, step, noise, min_readings, masks):
    """Write the masks of the objects in boxes, with holes.

    Args:
        borders: The boxes (N, 4) x1 y1 x2 y2, px.
        windows: The pixel ranges (N, 4) u1 v1 u2 v2 of the boxes, without u2 and v2.
        depth: The depth (H, W), m, 0 = no reading.
        significance: The minimum fraction of the weighted readings in the foreground.
        step: The maximum depth step between neighboring pixels, m per meter of depth.
        noise: The noise model of the sensor.
        min_readings: The minimum fraction of pixels with a depth reading in a box.
        masks: The output masks (N, H, W), initially False.

    Returns:
        An array (N,) that is True for boxes with a mask.
    """
    found = np.zeros(len(masks), np.bool_)
    for i in range(len(masks)):
        u0, v0, u1, v1 = windows[i]
        if u1 <= u0 or v1 <= v0:
            continue
        window = depth[v0:v1, u0:u1]
        if (window > NEAREST).sum() < max(1.0, min_readings * window.size):
            continue
        weight_x, weight_y = _tent(borders[i, 0], borders[i, 2], u0, u1), _tent(borders[i, 1], borders[i, 3], v0, v1)
        near, far = _foreground(window, weight_x, weight_y, significance)
        if far <= near:
            continue
        _grow(window, weight_x, weight_y, near, far, step, noise, masks[i, v0:v1, u0:u1])
        found[i] = True
    return found


@njit(cache=True, nogil=True)
def _tent(start, end, first, stop):
    """Return the weights of pixels along one axis of a box.

    The weights decrease linearly from 1 at the center of the box to 0 at its borders.
    """
    center, half = 0.5 * (start + end), 0.5 * (end - start)
    # 1e-6 prevents weights of 0
    return np.maximum(0.0, 1.0 - np.abs(np.arange(first, stop) - center) / half) + 1e-6


@njit(cache=True, nogil=True)
def _foreground(window, weight_x, weight_y, significance):
    """Return the depth range (near, far), m, of the foreground.

    It is the nearest mode with sufficient weight. Without such a mode, it is the mode with the largest weight.
    """
    bins = int(np.log(FARTHEST / NEAREST) / BIN) + 1
    histogram = np.zeros(bins + 2)
    total = 0.0
    for v in range(window.shape[0]):
        for u in range(window.shape[1]):
            z = window[v, u]
            if NEAREST < z < FARTHEST:
                weight = weight_x[u] * weight_y[v]
                histogram[1 + int(np.log(z / NEAREST) / BIN)] += weight
                total += weight
    smooth = np.zeros(bins + 2)
    smooth[1:-1] = 0.25 * histogram[:-2] + 0.5 * histogram[1:-1] + 0.25 * histogram[2:]
    best, best_first, best_last = 0.0, 0, -1
    first = 0
    while first < len(smooth):
        if smooth[first] <= 0:
            first += 1
            continue
        peak, mass, last = smooth[first], histogram[first], first
        rising = True
        while last + 1 < len(smooth):
            following = smooth[last + 1]
            # a valley: low compared with the peak, and no longer falling
            if following <= 0 or (following < VALLEY * peak and not rising and following > smooth[last]):
                break
            rising = following >= smooth[last]
            last += 1
            mass += histogram[last]
            peak = max(peak, following)
        if mass > best:
            best, best_first, best_last = mass, first, last
        if mass >= significance * total:
            best_first, best_last = first, last
            break
        first = last + 1
    return NEAREST * np.exp((best_first - 1) * BIN), NEAREST * np.exp(best_last * BIN)


@njit(cache=True, nogil=True)
def _grow(window, weight_x, weight_y, near, far, step, noise, mask):
    """Write the mask of the connected foreground component with the largest weight."""
    height, width = window.shape
    label = np.zeros((height, width), np.int32)
    stack = np.empty((height * width, 2), np.int32)
    best, best_weight, labels = 0, -1.0, 0
    for v0 in range(height):
        for u0 in range(width):
            if label[v0, u0] or not near <= window[v0, u0] <= far:
                continue
            labels += 1
            label[v0, u0] = labels
            stack[0] = v0, u0
            n, weight = 1, 0.0
            while n:
                n -= 1
                v, u = stack[n]
                weight += weight_x[u] * weight_y[v]
                z = window[v, u]
                for dv, du in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                    y, x = v + dv, u + du
                    if y < 0 or x < 0 or y >= height or x >= width or label[y, x]:
                        continue
                    other = window[y, x]
                    if near <= other <= far and abs(other - z) <= _largest_step(min(other, z), step, noise):
                        label[y, x] = labels
                        stack[n] = y, x
                        n += 1
            if weight > best_weight:
                best, best_weight = labels, weight
    for v in range(height):
        for u in range(width):
            mask[v, u] = label[v, u] == best


@njit(cache=True, nogil=True)
def _largest_step(z, step, noise):
    """Return the maximum depth step, m, between neighboring pixels of a surface at depth `z`, m."""
    return step * z + SIGMAS * axial_sigma(z, noise)
