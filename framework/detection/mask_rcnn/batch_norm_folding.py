"""Batch normalization as part of the convolution before it: the same numbers, with less memory traffic."""

from __future__ import annotations

from itertools import pairwise

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


def fuse_batch_norms(network: nn.Module) -> None:
    """Replaces, in place, each nn.BatchNorm2d by nothing, and scales the convolution that it follows.

    It follows the convolution that was registered right before it, as in every network here. Only for a network that
    is ready to run (`eval`): in training, normalization depends on the batch.
    """
    for module in network.modules():
        for (name, layer), (next_name, next_layer) in pairwise(list(module.named_children())):
            if isinstance(layer, nn.Conv2d) and isinstance(next_layer, nn.BatchNorm2d):
                setattr(module, name, fuse_conv_bn_eval(layer, next_layer))
                setattr(module, next_name, nn.Identity())
