"""RoIAlign (He et al., "Mask R-CNN", 2017) in plain torch.

torchvision's implementation is not used, because its extension requires a matching build of torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

PRODUCT_SPEED = 10.0  # speed of a multiplication in a matrix product divided by the speed in a weighted sum, on a CPU
CHUNK = 1 << 22  # maximum number of weights in memory at once


def roi_align(
    features: Tensor,
    boxes: Tensor,
    bins: int,
    spatial_scale: float,
    sampling_ratio: int = 0,
    half_pixel: bool = False,
) -> Tensor:
    """Return the features (N, C, bins, bins) pooled from N boxes.

    Each bin is the mean of bilinear samples on a regular grid. The result is differentiable and has channels-last
    memory format.

    Args:
        features: The feature map (1, C, H, W).
        boxes: The boxes (N, 4) x1 y1 x2 y2, px of the network's input.
        bins: The number of bins per side of a box.
        spatial_scale: The number of feature cells per pixel of the input.
        sampling_ratio: The number of samples per side of a bin; 0 = one per covered cell.
        half_pixel: True = "aligned" as in detectron2; False = the older convention. In the older convention, the center
            of cell i is at the input coordinate i / spatial_scale, and boxes are at least one cell wide.
    """
    channels, height, width = features.shape[1:]
    boxes_cells = boxes.float() * spatial_scale - (0.5 if half_pixel else 0.0)
    shortest = 0.0 if half_pixel else 1.0
    x = Samples.along(boxes_cells[:, 0], boxes_cells[:, 2], bins, width, sampling_ratio, shortest)
    y = Samples.along(boxes_cells[:, 1], boxes_cells[:, 3], bins, height, sampling_ratio, shortest)
    cells = features[0].permute(1, 2, 0).reshape(height * width, channels)
    # Bilinear pooling is separable: A_y F A_x^T, which costs O(bins H W) per box as matrix products. Each row of the
    # matrices is zero outside a window of a few cells. A weighted sum over the windows costs O(bins^2 window^2).
    sums = float((x.windows * y.windows).sum()) * bins * PRODUCT_SPEED
    products = len(boxes) * float(height * width + bins * width)
    return _sums(cells, x, y) if sums <= products else _products(cells, x, y)


@dataclass(frozen=True)
class Samples:
    """Sampling positions in N boxes along one axis of a feature map."""

    start: Tensor  # (N,) in cells
    size: Tensor  # (N,) in cells
    counts: Tensor  # (N,) number of samples per bin
    windows: Tensor  # (N,) int64, number of cells in reach of the samples of one bin
    bins: int
    cells: int  # number of cells of the feature map along the axis

    @classmethod
    def along(cls, start: Tensor, end: Tensor, bins: int, cells: int, ratio: int, shortest: float) -> Samples:
        """Create the samples of boxes along one axis.

        Args:
            start: The first border (N,) of the boxes, cells.
            end: The second border (N,) of the boxes, cells.
            bins: The number of bins per box.
            cells: The number of cells of the feature map.
            ratio: The number of samples per bin; 0 = one per covered cell.
            shortest: The minimum length of a box, cells. Shorter boxes are extended.
        """
        size = (end - start).clamp(min=shortest)
        counts = torch.full_like(size, ratio) if ratio else (size / bins).ceil().clamp(min=1.0)
        spread = size / bins * (counts - 1) / counts  # distance between the first and last sample of a bin
        windows = (spread.ceil() + 2).clamp(max=cells).long()
        return cls(start, size, counts, windows, bins, cells)

    def of(self, chosen: Tensor) -> Samples:
        """Return the samples of some of the boxes."""
        start, size, counts, windows = (array[chosen] for array in (self.start, self.size, self.counts, self.windows))
        return Samples(start, size, counts, windows, self.bins, self.cells)

    def weights(self) -> tuple[Tensor, Tensor]:
        """Return the first cell (N, bins) of the window of each bin, and the weights (N, bins, window) of its cells."""
        most, window = (int(array.max()) if len(array) else 1 for array in (self.counts, self.windows))
        k = torch.arange(most, device=self.start.device)
        counts = self.counts[:, None, None]
        fraction = (torch.arange(self.bins, device=k.device)[:, None] + (k + 0.5) / counts) / self.bins
        x = self.start[:, None, None] + fraction * self.size[:, None, None]  # (N, bins, most)
        counted = (k < counts) & (x >= -1) & (x <= self.cells)  # samples farther outside are zero
        x = x.clamp(0, self.cells - 1)
        first = x[..., 0].floor().clamp(max=self.cells - window)
        cell = first[..., None, None] + torch.arange(window, device=k.device)  # (N, bins, 1, window)
        weights = (1 - (x[..., None] - cell).abs()).clamp(min=0) * counted[..., None]
        return first.long(), weights.sum(dim=2) / counts

    def matrices(self) -> Tensor:
        """Return the weights of all cells as matrices (N, bins, cells)."""
        first, weights = self.weights()
        cells = first[..., None] + torch.arange(weights.shape[2], device=first.device)
        return weights.new_zeros((*first.shape, self.cells)).scatter_(2, cells, weights)


def _products(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """Return the pooled features (N, C, bins, bins), computed as matrix products."""
    rows = y.matrices().to(cells.dtype).reshape(-1, y.cells) @ cells.reshape(y.cells, -1)
    pooled = x.matrices().to(cells.dtype)[:, None] @ rows.view(-1, y.bins, x.cells, cells.shape[1])
    return pooled.permute(0, 3, 1, 2)


def _sums(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """Return the pooled features (N, C, bins, bins), computed as weighted sums over windows of cells."""
    sizes = x.windows * y.windows
    largest = int(sizes.max()) if len(sizes) else 1  # the largest window determines the cost of a chunk
    at_once = max(1, CHUNK // (x.bins * y.bins * largest))
    if len(sizes) <= at_once:
        return _sum_chunk(cells, x, y).permute(0, 3, 1, 2)
    pooled = cells.new_empty((len(sizes), y.bins, x.bins, cells.shape[1]))
    for chosen in sizes.argsort().split(at_once):  # type: ignore[no-untyped-call]
        pooled[chosen] = _sum_chunk(cells, x.of(chosen), y.of(chosen))
    return pooled.permute(0, 3, 1, 2)


def _sum_chunk(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """Return the pooled features (N, bins, bins, C) of boxes that are processed together."""
    first_x, weights_x = x.weights()
    first_y, weights_y = y.weights()
    column = first_x[..., None] + torch.arange(weights_x.shape[2], device=cells.device)
    row = first_y[..., None] + torch.arange(weights_y.shape[2], device=cells.device)
    index = row[:, :, None, :, None] * x.cells + column[:, None, :, None, :]  # (N, bins, bins, window y, window x)
    weights = weights_y[:, :, None, :, None] * weights_x[:, None, :, None, :]
    flat = (-1, weights_y.shape[2] * weights_x.shape[2])
    bags = functional.embedding_bag(
        index.reshape(flat), cells, mode="sum", per_sample_weights=weights.reshape(flat).to(cells.dtype)
    )
    return bags.view(len(first_x), y.bins, x.bins, cells.shape[1])
