"""Cluster refinement by density: an object is one dense piece, what a mask caught beside it is another or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Frame, PointClusters
from framework.interfaces import ClusterRefiner
from framework.refinement.density_clustering import in_densest_piece
from framework.refinement.selection import keep_points


@dataclass
class Dbscan(ClusterRefiner):
    """Keeps of each cluster its largest dense piece.

    DBSCAN (Ester, Kriegel, Sander and Xu, "A Density-Based Algorithm for Discovering Clusters in Large Spatial
    Databases with Noise", KDD 1996), as scikit-learn has it. A core point has at least `min_points` points, itself
    among them, within eps = `eps` + `eps_per_depth` * the cluster's median depth. Core points within eps of each other
    hang together; the piece with the most of them stays, of equally large ones the one seen first in the image, with
    all points within eps of its core points. (Such border points may be near to other pieces too; DBSCAN gives them to
    whichever comes first, here they stay.)

    With a `stride` above 1 only the pixels of every `stride`-th row and column are searched for core points, and
    `min_points` counts these; all points are judged by them. Where that leaves more than `max_points` of a cluster, the
    stride is the next larger one that does not, and each point counts for as many as it stands for. A cluster without
    any core point, too sparse to tell, is left as it is. A dropped point leaves the arrays, clusters keep their index.
    """

    eps: float = 0.04  # m, from 0.001
    eps_per_depth: float = 0.01  # m per m, from 0; the spacing of readings grows with depth
    min_points: int = 10  # from 1
    stride: int = 2  # px, from 1; 1 = no thinning
    max_points: int = 20000  # from 100, of a cluster that are searched: their pairs within eps are kept in memory

    def __post_init__(self) -> None:
        check_bounds(
            self,
            eps=(1e-3, np.inf),
            eps_per_depth=(0.0, np.inf),
            min_points=(1, 10**9),
            stride=(1, 64),
            max_points=(100, 10**9),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        kept = in_densest_piece(
            clusters,
            frame,
            eps=self.eps,
            eps_per_depth=self.eps_per_depth,
            min_points=self.min_points,
            stride=self.stride,
            max_points=self.max_points,
        )
        return keep_points(clusters, kept)
