"""Fixed distortion of the depth of a sensor.

Sensors that triangulate, such as the Kinect, have a fixed error of disparity in each pixel. The error of depth grows
with the square of depth and varies slowly over the image (Teichman, Miller and Thrun, "Unsupervised Intrinsic
Calibration of Depth Sensors via SLAM", RSS 2013). The corrected depth is

    z' = z + d(u, v) z^2

where d is interpolated bilinearly between the nodes of a grid over the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

NODES = (7, 9)  # rows and columns of nodes; the first and the last are at the outer pixels of the image


@dataclass(frozen=True, eq=False)
class DepthDistortion:
    """A correction of depth images of one size."""

    nodes: NDArray[np.float64]  # (R, C) corrections d, 1/m
    shape: tuple[int, int]  # height and width of the images, px

    @cached_property
    def corrections(self) -> NDArray[np.float32]:
        """The correction d of each pixel (H, W), 1/m."""
        rows, columns = (
            weights_of_nodes(size, count) for size, count in zip(self.shape, self.nodes.shape, strict=True)
        )
        # not a product of matrices, whose last digits depend on the number of BLAS threads
        corrections: NDArray[np.float64] = np.einsum("vr,rc,uc->vu", rows, self.nodes, columns)
        return corrections.astype(np.float32)

    def corrected(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a corrected depth image (H, W), m, 0 = no reading. Images of another size are returned unchanged."""
        return np.maximum(depth + self.corrections * depth * depth, 0) if depth.shape == self.shape else depth


def weights_of_nodes(size: int, count: int) -> NDArray[np.float64]:
    """Return the weights (size, count) of the nodes along one side of an image, for each pixel."""
    positions = np.arange(size) * (count - 1) / max(size - 1, 1)
    weights: NDArray[np.float64] = np.maximum(1 - np.abs(positions[:, None] - np.arange(count)), 0)
    return weights
