"""RoIAlign against Detectron's and torchvision's loops, written out sample by sample."""

import math

import numpy as np
import pytest
import torch

from framework.detection.roi_align import roi_align


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


def loops(plane, boxes, bins, scale, ratio, half_pixel):
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


@pytest.mark.parametrize("ratio", [0, 2])
@pytest.mark.parametrize("half_pixel", [False, True])
def test_agrees_with_the_loops(ratio, half_pixel):
    rng = np.random.default_rng(3)
    plane = rng.normal(0, 1, (5, 20, 27)).astype(np.float32)
    corners = rng.uniform(-40, 350, (25, 2))
    boxes = np.hstack([corners, corners + rng.uniform(0.5, 300, (25, 2))]).astype(np.float32)
    boxes[0] = (0, 0, 426, 319)  # the whole image
    boxes[1] = (3, 3, 5, 5)  # smaller than a cell
    expected = loops(plane, boxes, 6, 1 / 16, ratio, half_pixel)
    found = roi_align(torch.from_numpy(plane)[None], torch.from_numpy(boxes), 6, 1 / 16, ratio, half_pixel)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_a_linear_ramp_is_pooled_to_the_centres_of_the_bins():
    y, x = np.meshgrid(np.arange(20.0), np.arange(27.0), indexing="ij")
    ramp = torch.from_numpy((3 * x - 2 * y).astype(np.float32))[None, None]
    box = torch.tensor([[32.0, 48.0, 32.0 + 6 * 32, 48.0 + 6 * 16]])  # bins of 2 x 1 cells
    i, j = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
    expected = 3 * (2 + 2 * (j + 0.5)) - 2 * (3 + (i + 0.5))
    np.testing.assert_allclose(roi_align(ramp, box, 6, 1 / 16)[0, 0].numpy(), expected, atol=1e-4)


def test_no_boxes():
    assert roi_align(torch.zeros(1, 4, 5, 6), torch.zeros(0, 4), 6, 1 / 16).shape == (0, 4, 6, 6)
