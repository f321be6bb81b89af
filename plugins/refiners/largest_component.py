"""Cluster refinement by connectivity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.connected_pieces import in_largest_piece
from framework.refinement.connected_pieces_kernels import Connection
from framework.refinement.refine import keep_points


@dataclass
class LargestComponent(ClusterRefiner):
    """Selection of the largest connected component of each cluster.

    Two points are connected if their pixels are at most `connection_radius` apart and their depth difference is small.
    The allowed difference increases with depth, because the spacing and the noise of readings do. Ties go to the first
    component in the image.
    """

    max_gap: float = 0.03  # maximum depth step between connected pixels at depth 0, m, >= 0
    gap_per_depth: float = 0.02  # increase of the maximum depth step with depth, m per m, >= 0
    # maximum distance between connected pixels, px, in [1, 16]; 2 bridges single missing readings
    connection_radius: int = 2

    def __post_init__(self) -> None:
        check_bounds(self, max_gap=(0.0, np.inf), gap_per_depth=(0.0, np.inf), connection_radius=(1, 16))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        connection = Connection(np.float32(self.max_gap), np.float32(self.gap_per_depth), self.connection_radius)
        return keep_points(clusters, in_largest_piece(clusters, frame, connection))
