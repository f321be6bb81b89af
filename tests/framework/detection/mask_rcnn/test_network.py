"""Fused normalization: the same network, fewer layers."""

import torch
from torch import nn

from framework.detection.mask_rcnn.network import fuse_batch_norms
from tests.support.networks.tiny_mask_rcnn import tiny_network


def test_a_fused_network_computes_the_same():
    network, fused = tiny_network(), tiny_network()
    fuse_batch_norms(fused)
    assert sum(isinstance(module, nn.BatchNorm2d) for module in network.modules()) == 20  # 17 layers, 3 shortcuts
    assert not [module for module in fused.modules() if isinstance(module, nn.BatchNorm2d)]
    images = network.normalize(torch.rand(1, 3, 64, 96) * 255)
    with torch.inference_mode():
        for expected, found in zip(network.extract(images), fused.extract(images), strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
            assert expected.std() > 0.1
