"""RoIAlign (He et al., "Mask R-CNN", 2017) as two matrix products, or as weighted sums of cells: what is cheaper.

Hand-written, for torchvision's extension loads only beside its own build of torch, and torch has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

PRODUCT_SPEED = 10.0  # multiplications in a matrix product in the time of one in a weighted sum; measured on a CPU
CHUNK = 1 << 22  # weights that are in memory at once


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
    box is A_y F A_x^T with one (bins, H) and one (bins, W) matrix. Written so, it costs O(bins H W) a box whatever the
    box's size, and suits maps of few cells. But each row of the matrices is zero outside a window of a few cells; a
    weighted sum over the windows' cells costs O(bins^2 window^2) whatever the map's size. The cheaper one is taken.
    Gradients reach the features through both.
    """
    channels, height, width = features.shape[1:]
    placed = boxes.float() * spatial_scale - (0.5 if half_pixel else 0.0)
    shortest = 0.0 if half_pixel else 1.0
    x = Samples.along(placed[:, 0], placed[:, 2], bins, width, sampling_ratio, shortest)
    y = Samples.along(placed[:, 1], placed[:, 3], bins, height, sampling_ratio, shortest)
    cells = features[0].permute(1, 2, 0).reshape(height * width, channels)
    sums = float((x.windows * y.windows).sum()) * bins * PRODUCT_SPEED
    products = len(boxes) * float(height * width + bins * width)
    return _sums(cells, x, y) if sums <= products else _products(cells, x, y)


@dataclass(frozen=True)
class Samples:
    """Where N boxes are sampled along one axis of a map."""

    start: Tensor  # (N,) in cells
    size: Tensor  # (N,) in cells
    counts: Tensor  # (N,) samples a bin
    windows: Tensor  # (N,) int64, cells that the samples of one bin can touch
    bins: int
    cells: int  # of the map

    @classmethod
    def along(cls, start: Tensor, end: Tensor, bins: int, cells: int, ratio: int, shortest: float) -> Samples:
        """Those between `start` and `end` (N,) in cells; a box is at least `shortest` cells long."""
        size = (end - start).clamp(min=shortest)
        counts = torch.full_like(size, ratio) if ratio else (size / bins).ceil().clamp(min=1.0)
        spread = size / bins * (counts - 1) / counts  # from a bin's first sample to its last
        windows = (spread.ceil() + 2).clamp(max=cells).long()
        return cls(start, size, counts, windows, bins, cells)

    def of(self, chosen: Tensor) -> Samples:
        """Those of the boxes that an index chooses."""
        start, size, counts, windows = (array[chosen] for array in (self.start, self.size, self.counts, self.windows))
        return Samples(start, size, counts, windows, self.bins, self.cells)

    def weights(self) -> tuple[Tensor, Tensor]:
        """(first cell (N, bins) int64, weights (N, bins, window)) of the window in which each bin's samples lie."""
        most, window = (int(array.max()) if len(array) else 1 for array in (self.counts, self.windows))
        k = torch.arange(most, device=self.start.device)
        counts = self.counts[:, None, None]
        place = (torch.arange(self.bins, device=k.device)[:, None] + (k + 0.5) / counts) / self.bins
        x = self.start[:, None, None] + place * self.size[:, None, None]  # (N, bins, most)
        counted = (k < counts) & (x >= -1) & (x <= self.cells)  # what lies further out counts as zeros
        x = x.clamp(0, self.cells - 1)
        first = x[..., 0].floor().clamp(max=self.cells - window)
        cell = first[..., None, None] + torch.arange(window, device=k.device)  # (N, bins, 1, window)
        weights = (1 - (x[..., None] - cell).abs()).clamp(min=0) * counted[..., None]
        return first.long(), weights.sum(dim=2) / counts

    def matrices(self) -> Tensor:
        """The weights as (N, bins, cells)."""
        first, weights = self.weights()
        places = first[..., None] + torch.arange(weights.shape[2], device=first.device)
        return weights.new_zeros((*first.shape, self.cells)).scatter_(2, places, weights)


def _products(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """A_y F A_x^T for each box."""
    rows = y.matrices().to(cells.dtype).reshape(-1, y.cells) @ cells.reshape(y.cells, -1)
    pooled = x.matrices().to(cells.dtype)[:, None] @ rows.view(-1, y.bins, x.cells, cells.shape[1])
    return pooled.permute(0, 3, 1, 2)


def _sums(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """The same as sums over windows; boxes of like windows go together, for a chunk's widest one sets its cost."""
    sizes = x.windows * y.windows
    largest = int(sizes.max()) if len(sizes) else 1
    at_once = max(1, CHUNK // (x.bins * y.bins * largest))
    if len(sizes) <= at_once:
        return _sum_chunk(cells, x, y).permute(0, 3, 1, 2)
    pooled = cells.new_empty((len(sizes), y.bins, x.bins, cells.shape[1]))
    for chosen in sizes.argsort().split(at_once):  # type: ignore[no-untyped-call]
        pooled[chosen] = _sum_chunk(cells, x.of(chosen), y.of(chosen))
    return pooled.permute(0, 3, 1, 2)


def _sum_chunk(cells: Tensor, x: Samples, y: Samples) -> Tensor:
    """(N, bins, bins, C): every bin is a bag of cells, each with the product of its two weights."""
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
