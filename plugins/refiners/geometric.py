"""Cluster refinement by convexity: the geometric segments that Voxblox++ puts its instances together from."""

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

    The rival idea: Voxblox++ (Grinvald et al., RA-L 2019) cuts the depth image where depth jumps or the surface is
    concave, and gives each segment to the one mask that covers most of it, if that is more than `min_overlap` of its
    pixels. A cluster so loses what its mask caught beside its segments. With `grow_to_segments` it also grows to their
    pixels outside of the mask, as in Voxblox++: these have exact readings, and the camera's pose, which takes them to
    the world, follows from the points that there are already; where those are too few or on one line, nothing is
    added. A mask that covers no segment loses all its points; clusters keep their index. Points of no cluster stay.
    """

    cell_size: int = 2  # px, from 1: side of the squares whose readings are averaged
    window_radius: int = 3  # cells, from 1: planes are fitted to squares of 2 window + 1 cells
    noise_factor: float = 3.0  # from 0.1, standard deviations of a structured-light camera's depth that count as noise
    min_noise: float = 0.0  # m, from 0, least standard deviation of depth: where readings are rounded, half a step
    max_slope: float = 4.0  # m per m, from 0.1: steeper against the line of sight, depth jumps (4: 76 degrees)
    max_angle: float = 15.0  # degrees, in (0, 90): a surface bent more towards the camera, and more than noise, is cut
    closing_radius: int = 1  # cells, from 0: gaps in edges up to twice as wide are closed
    min_segment: int = 100  # px, from 1: smaller segments go to those beside them
    min_overlap: float = 0.8  # in [0, 1), share of a segment that a mask must cover to get it
    grow_to_segments: bool = True  # whether clusters grow to their segments' pixels outside of the mask

    def __post_init__(self) -> None:
        check_bounds(
            self,
            cell_size=(1, 16),
            window_radius=(1, 16),
            noise_factor=(0.1, 100.0),
            min_noise=(0.0, 1.0),
            max_slope=(0.1, 100.0),
            max_angle=(1e-3, 89.0),
            closing_radius=(0, 16),
            min_segment=(1, 10**9),
            min_overlap=(0.0, 1 - 1e-6),
        )
        self.limits = Limits(self.noise_factor, self.min_noise, self.max_slope, float(np.deg2rad(self.max_angle)))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if len(clusters) == 0:
            return clusters
        labels, count = segments(
            frame.depth,
            frame.camera,
            cell=self.cell_size,
            window=self.window_radius,
            limits=self.limits,
            closing=self.closing_radius,
            min_pixels=self.min_segment,
        )
        return owned_segments(clusters, frame, labels, count, self.min_overlap, self.grow_to_segments)
