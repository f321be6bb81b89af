"""A tiny Mask R-CNN with random weights."""

from __future__ import annotations

from pathlib import Path

import torch

from framework.detection.mask_rcnn.network import Architecture, MaskRCNN
from framework.detection.mask_rcnn.network_file import save_network
from framework.detection.mask_rcnn.resnet import ResNetShape

TINY = Architecture(
    classes=("chair", "couch", "dining table"),
    backbone=ResNetShape("resnet18", width=4),
    fpn_channels=8,
    head_features=16,
    anchor_sides=(8.0, 16.0, 32.0, 64.0, 128.0),
    short_side=96,
    long_side=160,
)


def tiny_network(architecture: Architecture = TINY, seed: int = 0) -> MaskRCNN:
    """Return the network. The normalization statistics are random, so that every operation has an effect."""
    generator = torch.Generator().manual_seed(seed)
    network = MaskRCNN(architecture).eval()
    for name, tensor in network.state_dict().items():
        if name.endswith("running_var") or (name.endswith("weight") and tensor.ndim == 1):
            tensor.uniform_(0.5, 1.5, generator=generator)
        elif tensor.ndim == 1:
            tensor.normal_(0, 0.1, generator=generator)
        elif tensor.ndim > 1:
            gain = 0.3 if "predictor" in name else 1.0  # no class may be certain
            tensor.normal_(0, gain / tensor[0].numel() ** 0.5, generator=generator)
    return network


def tiny_network_file(folder: Path) -> Path:
    """Write the network to a file in `folder` and return its path."""
    path = folder / "tiny_mask_rcnn.safetensors"
    save_network(tiny_network(), path, {"data": "none: the weights are random"})
    return path
