"""Cluster refinement by convexity: the geometric segments of Voxblox++."""

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
    """Makes each cluster the union of the convex segments of the depth image that its mask covers.

    Voxblox++ (Grinvald et al., RA-L 2019) cuts the depth image where depth jumps or the surface is concave, and assigns
    each segment to the mask that covers most of it, if that is more than `min_overlap` of its pixels. A cluster loses
    its points outside of its segments. With `grow_to_segments` it also gains the segments' pixels outside of the mask,
    if the cluster's points determine the camera's pose. A mask without a segment loses all points.
    """

    cell_size: int = 2  # px, from 1, side of the squares whose readings are averaged
    window_radius: int = 3  # cells, from 1, of the squares that planes are fitted to
    noise_factor: float = 3.0  # from 0.1, standard deviations of a structured-light camera's depth that count as noise
    min_noise: float = 0.0  # m, from 0, smallest standard deviation of depth; half a step if readings are rounded
    max_slope: float = 4.0  # m per m, from 0.1; where the surface is steeper, depth jumps (4: 76 degrees)
    max_angle: float = 15.0  # degrees, in (0, 90); a surface with a larger concave angle, and more than noise, is cut
    closing_radius: int = 1  # cells, from 0; gaps in edges up to twice as wide are closed
    min_segment: int = 100  # px, from 1; smaller segments are merged with their neighbors
    min_overlap: float = 0.8  # in [0, 1), ratio of a segment that its mask must cover
    grow_to_segments: bool = True  # add the segments' pixels outside of the mask

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
            closing=self.closing_radius, min_pixels=self.min_segment,
        )  # fmt: skip
        return owned_segments(clusters, frame, labels, count, self.min_overlap, self.grow_to_segments)
