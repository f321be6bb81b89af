"""RoIAlign (He et al., "Mask R-CNN", 2017) as two matrix products."""

from __future__ import annotations

import torch
from torch import Tensor


def roi_align(
    features: Tensor,
    boxes: Tensor,
    bins: int,
    spatial_scale: float,
    sampling_ratio: int = 0,
    half_pixel: bool = False,
) -> Tensor:
    """The features of each box on a bins x bins grid, averaged over bilinear samples at regular places of each bin.

    features (1, C, H, W); boxes (N, 4) x1 y1 x2 y2 px of the image; returns (N, C, bins, bins) in the channels-last
    memory format. `spatial_scale`: cells per pixel. `sampling_ratio`: samples a side and bin, 0 = one for each cell
    that the bin covers. `half_pixel`: False is the old convention, where cell i is centred at image coordinate
    i / spatial_scale and a box is at least one cell wide; True the newer one ("aligned").

    The bilinear weights of a sample factorise into x and y, and so does their mean over a grid of samples: pooling a
    box is A_y F A_x^T with one (bins, H) and one (bins, W) matrix. That costs O(bins H W) a box whatever its size;
    for maps of a few thousand cells it is faster than gathering samples, and runs on any device.
    """
    channels, height, width = features.shape[1:]
    A_x = _axis_weights(boxes[:, 0], boxes[:, 2], bins, width, spatial_scale, sampling_ratio, half_pixel)
    A_y = _axis_weights(boxes[:, 1], boxes[:, 3], bins, height, spatial_scale, sampling_ratio, half_pixel)
    cells = features[0].permute(1, 2, 0).reshape(height, width * channels)
    rows = (A_y.reshape(-1, height) @ cells).view(-1, bins, width, channels)
    pooled = A_x[:, None].to(rows.dtype) @ rows
    return pooled.permute(0, 3, 1, 2)


def _axis_weights(
    start: Tensor, end: Tensor, bins: int, cells: int, spatial_scale: float, sampling_ratio: int, half_pixel: bool
) -> Tensor:
    """(N, bins, cells): how much each cell along one axis contributes to each bin of each box."""
    offset = 0.5 if half_pixel else 0.0
    start, end = start * spatial_scale - offset, end * spatial_scale - offset
    size = end - start if half_pixel else (end - start).clamp(min=1.0)
    samples = torch.full_like(size, sampling_ratio) if sampling_ratio else (size / bins).ceil().clamp(min=1.0)
    most = int(samples.max()) if len(samples) else 1
    k = torch.arange(most, device=start.device)
    place = (torch.arange(bins, device=start.device)[:, None] + (k + 0.5) / samples[:, None, None]) / bins
    x = start[:, None, None] + place * size[:, None, None]  # (N, bins, most)
    inside = (k < samples[:, None, None]) & (x >= -1) & (x <= cells)  # what lies further out counts as zeros
    x = x.clamp(0, cells - 1)
    weights = (1 - (x[..., None] - torch.arange(cells, device=start.device)).abs()).clamp(min=0)
    return (weights * inside[..., None]).sum(dim=2) / samples[:, None, None]
