"""Slow reference for RoIAlign, sample by sample like in Detectron and torchvision."""

import math

import numpy as np


def bilinear(plane, y, x):
    height, width = plane.shape[-2:]
    if y < -1 or y > height or x < -1 or x > width:
        return np.zeros(plane.shape[0])
    y, x = max(y, 0.0), max(x, 0.0)
    y0, x0 = min(int(y), height - 1), min(int(x), width - 1)
    y1, x1 = min(y0 + 1, height - 1), min(x0 + 1, width - 1)
    wy, wx = (0.0 if y0 == y1 else y - y0), (0.0 if x0 == x1 else x - x0)
    top = plane[:, y0, x0] * (1 - wx) + plane[:, y0, x1] * wx
    bottom = plane[:, y1, x0] * (1 - wx) + plane[:, y1, x1] * wx
    return top * (1 - wy) + bottom * wy


def roi_align_loops(plane, boxes, bins, scale, ratio, half_pixel):
    """Return the pooled values (N, C, bins, bins) of boxes (N, 4), px, in a feature map (C, H, W)."""
    pooled = np.zeros((len(boxes), plane.shape[0], bins, bins))
    offset = 0.5 if half_pixel else 0.0
    for n, box in enumerate(boxes):
        x1, y1, x2, y2 = (float(c) * scale - offset for c in box)
        width, height = x2 - x1, y2 - y1
        if not half_pixel:
            width, height = max(width, 1.0), max(height, 1.0)
        ny = ratio or max(1, math.ceil(height / bins))
        nx = ratio or max(1, math.ceil(width / bins))
        for i in range(bins):
            for j in range(bins):
                samples = [
                    bilinear(plane, y1 + (i + (a + 0.5) / ny) * height / bins, x1 + (j + (b + 0.5) / nx) * width / bins)
                    for a in range(ny)
                    for b in range(nx)
                ]
                pooled[n, :, i, j] = np.mean(samples, axis=0)
    return pooled
