"""Cluster refinement by connectivity and depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.connected_pieces import in_near_pieces
from framework.refinement.connected_pieces_kernels import Connection
from framework.refinement.refine import keep_points


@dataclass
class Connected(ClusterRefiner):
    """Selection of the largest connected component of each cluster, and of components at a similar depth.

    Connected components are defined as in `largest_component`. A component is kept if most of its points agree in depth
    with the nearest kept point. The allowed difference increases with the lateral distance. This removes background,
    such as the carpet between the slats of a chair. Object parts that are separated by occlusion or missing readings
    are kept.
    """

    max_gap: float = 0.1  # maximum depth step between connected pixels at depth 0, m, >= 0
    gap_per_depth: float = 0.02  # increase of the maximum depth step with depth, m per m, >= 0
    # maximum distance between connected pixels, px, in [1, 16]; 2 bridges single missing readings
    connection_radius: int = 2
    # minimum ratio of a component's number of pixels to that of the largest component, in [0, 1]; smaller components
    # are dropped
    min_piece_ratio: float = 0.05
    # maximum ratio of depth difference to lateral distance of a component from the nearest kept point, m per m, >= 0
    max_depth_slope: float = 2.0

    def __post_init__(self) -> None:
        check_bounds(
            self, max_gap=(0.0, np.inf), gap_per_depth=(0.0, np.inf), connection_radius=(1, 16),
            min_piece_ratio=(0.0, 1.0), max_depth_slope=(0.0, np.inf),
        )  # fmt: skip

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        connection = Connection(np.float32(self.max_gap), np.float32(self.gap_per_depth), self.connection_radius)
        kept = in_near_pieces(clusters, frame, connection, self.min_piece_ratio, self.max_depth_slope)
        return keep_points(clusters, kept)
