"""Cluster refinement by convexity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.segmentation.convexity import Limits, segments
from framework.refinement.segmentation.segment_owners import owned_segments


@dataclass
class Geometric(ClusterRefiner):
    """Clusters as unions of convex depth segments.

    As in Voxblox++ (Grinvald et al., RA-L 2019), the depth image is cut at depth jumps and concave creases. Each
    segment is assigned to the mask with the largest overlap, if the mask covers more than `min_overlap` of the segment.
    Points of a cluster outside its segments are removed. With `grow_to_segments`, the pixels of its segments outside
    the mask are added. A cluster without a segment becomes empty.
    """

    cell_size: int = 2  # side of the cells in which depth readings are averaged, px, in [1, 16]
    window_radius: int = 3  # radius of the square windows for plane fits, in cells, in [1, 16]
    noise_factor: float = 3.0  # maximum depth difference that counts as noise, in standard deviations, in [0.1, 100]
    # minimum standard deviation of depth, m, in [0, 1]; for coarsely quantized depth, set half of the quantization step
    min_noise: float = 0.0
    # maximum slope of a surface, m per m, in [0.1, 100]; steeper steps are depth jumps (4 = 76 degrees)
    max_slope: float = 4.0
    max_angle: float = 15.0  # maximum concave angle within a segment, in addition to noise, degrees, in [0.001, 89]
    closing_radius: int = 1  # radius of the morphological closing of edges, in cells, in [0, 16]
    min_segment: int = 100  # minimum number of pixels of a segment, >= 1; smaller segments are merged with neighbors
    min_overlap: float = 0.8  # minimum fraction of a segment inside a mask to assign it to the mask, in [0, 1)
    grow_to_segments: bool = True  # True = add the pixels of the assigned segments outside the mask

    def __post_init__(self) -> None:
        check_bounds(
            self, cell_size=(1, 16), window_radius=(1, 16), noise_factor=(0.1, 100.0), min_noise=(0.0, 1.0),
            max_slope=(0.1, 100.0), max_angle=(1e-3, 89.0), closing_radius=(0, 16), min_segment=(1, 10**9),
            min_overlap=(0.0, 1 - 1e-6),
        )  # fmt: skip
        self.limits = Limits(self.noise_factor, self.min_noise, self.max_slope, float(np.deg2rad(self.max_angle)))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if len(clusters) == 0:
            return clusters
        labels, count = segments(
            frame.depth, frame.camera, cell=self.cell_size, window=self.window_radius, limits=self.limits,
            closing=self.closing_radius, min_pixels=self.min_segment, sensor=frame.sensor,
        )  # fmt: skip
        return owned_segments(clusters, frame, labels, count, self.min_overlap, self.grow_to_segments)
