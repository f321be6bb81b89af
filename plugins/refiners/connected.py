"""Cluster refinement by connectivity: what a step in depth parts from the rest of a cluster is another thing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.connected_pieces import in_near_pieces
from framework.refinement.selection import keep_points


@dataclass
class Connected(ClusterRefiner):
    """Keeps of each cluster its largest piece that is connected in 3D, and those that may be parts of the same thing.

    Pieces are those of `largest_component`. What a mask has caught beside its object begins at a step in depth: the
    carpet between a chair's slats, the cupboard behind its back. A piece leaves when the step is larger than most of
    its points are far from what stays, `max_depth_slope` times; so a wide piece stays at a step that a narrow one
    would not, and walls are for `plane_removal`. A piece at a depth that the object's own surface may have at that
    distance stays, whatever is between: a chair before a couch, readings that are missing, the air between the legs of
    a table.

    That all points vote was chosen: by the nearest quarter of them, which sees the step alone, AP50 was 0.20 lower
    with maskrcnn2go on replica_floor2 (the leaves of a plant), and the same with YOLO11n-seg there, on ScanNet's
    scene0000_00 and in a synthetic room.
    """

    max_gap: float = 0.1  # m, from 0
    gap_per_depth: float = 0.02  # m per m, from 0
    connection_radius: int = 2  # px, from 1; 2 bridges single missing readings
    min_piece_ratio: float = 0.05  # in [0, 1], of the largest piece's points; a smaller piece is dropped
    max_depth_slope: float = 2.0  # m of depth a metre aside, from 0, by which two pieces of one object may be apart

    def __post_init__(self) -> None:
        check_bounds(
            self,
            max_gap=(0.0, np.inf),
            gap_per_depth=(0.0, np.inf),
            connection_radius=(1, 16),
            min_piece_ratio=(0.0, 1.0),
            max_depth_slope=(0.0, np.inf),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        kept = in_near_pieces(
            clusters,
            frame,
            self.max_gap,
            self.gap_per_depth,
            self.connection_radius,
            self.min_piece_ratio,
            self.max_depth_slope,
        )
        return keep_points(clusters, kept)
