"""Tests for fused batch normalization, anchors, and the selection of the best anchors."""

import numpy as np
import pytest
import torch
from torch import nn

from framework.detection.mask_rcnn.network import best_first, fuse_batch_norms
from tests.support.networks.tiny_mask_rcnn import tiny_network


def test_network_with_fused_batch_norms_matches_original():
    network, fused = tiny_network(), tiny_network()
    fuse_batch_norms(fused)
    assert sum(isinstance(module, nn.BatchNorm2d) for module in network.modules()) == 20  # 17 layers, 3 shortcuts
    assert not [module for module in fused.modules() if isinstance(module, nn.BatchNorm2d)]
    images = network.normalize(torch.rand(1, 3, 64, 96) * 255)
    with torch.inference_mode():
        for expected, found in zip(network.extract(images), fused.extract(images), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
            assert expected.std() > 0.1


@pytest.mark.parametrize("count", [1, 40, 99, 100, 200])
@pytest.mark.parametrize("decimals", [0, 6])  # with 0 digits, many scores are equal
def test_network_best_first_equals_stable_sort(count, decimals):
    scores = np.random.default_rng(3).normal(size=100).round(decimals).astype(np.float32)
    np.testing.assert_array_equal(best_first(scores, count), np.argsort(-scores, kind="stable")[:count])


def test_anchor_counts_match_pyramid_shapes():
    network = tiny_network()
    counts = []
    for height in (64, 64, 128, 64):
        images = network.normalize(torch.zeros(1, 3, height, 96))
        with torch.inference_mode():
            pyramid = network.extract(images)
        anchors = network.anchors(pyramid)
        counts.append([len(of_level) for of_level in anchors])
        assert counts[-1] == [3 * level.shape[2] * level.shape[3] for level in pyramid]
    assert counts[0] == counts[1] == counts[3] != counts[2]
