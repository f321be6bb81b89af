"""Tests for both implementations of RoIAlign, compared with the loops of Detectron and torchvision."""

import math

import numpy as np
import pytest
import torch

from framework.detection.mask_rcnn import roi_align as module
from framework.detection.mask_rcnn.roi_align import roi_align
from tests.support.networks.roi_align_loops import roi_align_loops


@pytest.fixture(params=["products", "sums"])
def path(request, monkeypatch):
    """Select one of the two implementations and return its name."""
    monkeypatch.setattr(module, "PRODUCT_SPEED", {"products": math.inf, "sums": 0.0}[request.param])
    other = {"products": "_sums", "sums": "_products"}[request.param]
    monkeypatch.setattr(module, other, lambda *_: pytest.fail("expected only the forced implementation"))
    return request.param


def random_boxes(rng, n):
    corners = rng.uniform(-40, 350, (n, 2))
    boxes = np.hstack([corners, corners + rng.uniform(0.5, 300, (n, 2))]).astype(np.float32)
    boxes[0] = (0, 0, 426, 319)  # the whole image
    boxes[1] = (3, 3, 5, 5)  # smaller than a cell
    boxes[2] = (-200, -100, -150, -90)  # outside
    return boxes


@pytest.mark.parametrize("ratio", [0, 2])
@pytest.mark.parametrize("half_pixel", [False, True])
def test_roi_align_matches_reference_loops(path, ratio, half_pixel):
    rng = np.random.default_rng(3)
    plane = rng.normal(0, 1, (5, 20, 27)).astype(np.float32)
    boxes = random_boxes(rng, 25)
    expected = roi_align_loops(plane, boxes, 6, 1 / 16, ratio, half_pixel)
    found = roi_align(torch.from_numpy(plane)[None], torch.from_numpy(boxes), 6, 1 / 16, ratio, half_pixel)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)


def test_roi_align_narrow_feature_map_matches_reference(path):
    rng = np.random.default_rng(4)
    plane = rng.normal(0, 1, (2, 1, 3)).astype(np.float32)
    boxes = np.array([[0, 0, 40, 12], [5, 1, 30, 200]], np.float32)
    expected = roi_align_loops(plane, boxes, 7, 1 / 16, 2, True)
    found = roi_align(torch.from_numpy(plane)[None], torch.from_numpy(boxes), 7, 1 / 16, 2, True)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def test_roi_align_chunks_keep_box_order(monkeypatch):
    rng = np.random.default_rng(5)
    features = torch.from_numpy(rng.normal(0, 1, (1, 3, 20, 27)).astype(np.float32))
    boxes = torch.from_numpy(random_boxes(rng, 30))
    whole = roi_align(features, boxes, 4, 1 / 16)
    monkeypatch.setattr(module, "PRODUCT_SPEED", 0.0)
    monkeypatch.setattr(module, "CHUNK", 1000)
    np.testing.assert_allclose(roi_align(features, boxes, 4, 1 / 16), whole, atol=1e-5)


@pytest.mark.parametrize("ratio", [0, 2])
def test_roi_align_gradient_matches_cell_contributions(path, ratio):
    """Pooling is linear. The gradient at a cell is therefore the pooled sum of a map that is 1 at this cell."""
    rng = np.random.default_rng(6)
    boxes = rng.uniform(0, 60, (4, 2))
    boxes = np.hstack([boxes, boxes + rng.uniform(4, 50, (4, 2))]).astype(np.float32)
    features = torch.zeros(1, 2, 5, 7, requires_grad=True)
    (2 * roi_align(features, torch.from_numpy(boxes), 3, 1 / 16, ratio, True)[:, 1]).sum().backward()
    units = np.eye(35, dtype=np.float32).reshape(35, 5, 7)
    expected = 2 * roi_align_loops(units, boxes, 3, 1 / 16, ratio, True).sum(axis=(0, 2, 3)).reshape(5, 7)
    np.testing.assert_allclose(features.grad[0, 1], expected, atol=1e-4)
    assert not features.grad[0, 0].any()


def test_roi_align_large_map_with_small_boxes_uses_sums(monkeypatch):
    monkeypatch.setattr(
        module, "_products", lambda *_: pytest.fail("expected sums; products take seconds for this map")
    )
    boxes = torch.rand(50, 2).repeat(1, 2) * 600 + torch.tensor([0.0, 0.0, 60.0, 40.0])
    assert roi_align(torch.zeros(1, 8, 200, 336), boxes, 7, 1 / 4, 2).shape == (50, 8, 7, 7)


def test_roi_align_small_map_with_large_boxes_uses_products(monkeypatch):
    monkeypatch.setattr(module, "_sums", lambda *_: pytest.fail("expected products, which are faster for this map"))
    boxes = torch.tensor([[0.0, 0.0, 200.0, 200.0]])
    assert roi_align(torch.zeros(1, 8, 13, 13), boxes, 7, 1 / 16).shape == (1, 8, 7, 7)


def test_roi_align_half_precision_keeps_box_coordinates(path):
    rng = np.random.default_rng(7)
    features = torch.from_numpy(rng.normal(0, 1, (1, 4, 30, 40)).astype(np.float32))
    boxes = torch.tensor([[1001.3, 903.7, 1181.9, 950.2]])
    single = roi_align(features, boxes, 7, 1 / 32, 2)
    half = roi_align(features.bfloat16(), boxes, 7, 1 / 32, 2)
    assert half.dtype == torch.bfloat16
    np.testing.assert_allclose(half.float(), single, atol=0.03)


def test_roi_align_linear_ramp_gives_bin_centers(path):
    y, x = np.meshgrid(np.arange(20.0), np.arange(27.0), indexing="ij")
    ramp = torch.from_numpy((3 * x - 2 * y).astype(np.float32))[None, None]
    box = torch.tensor([[32.0, 48.0, 32.0 + 6 * 32, 48.0 + 6 * 16]])  # bins of 2 x 1 cells
    i, j = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
    expected = 3 * (2 + 2 * (j + 0.5)) - 2 * (3 + (i + 0.5))
    np.testing.assert_allclose(roi_align(ramp, box, 6, 1 / 16)[0, 0].numpy(), expected, atol=1e-4)


def test_roi_align_without_boxes_is_empty(path):
    assert roi_align(torch.zeros(1, 4, 5, 6), torch.zeros(0, 4), 6, 1 / 16).shape == (0, 4, 6, 6)
