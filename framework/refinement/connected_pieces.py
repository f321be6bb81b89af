"""Connected components of a cluster, in the image and in depth.

A custom kernel is used, because OpenCV and SciPy label binary images. They ignore depth and connect only adjacent
pixels. A graph over all pairs of nearby pixels would have 12 edges per point.
"""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Frame, PointClusters
from framework.refinement.connected_pieces_kernels import Connection, find_pieces
from framework.refinement.neighborhood import members, thread_schedule

LARGEST_ONLY = 2.0  # min_ratio that only the largest component satisfies


def in_largest_piece(clusters: PointClusters, frame: Frame, connection: Connection) -> Bool:
    """Return an array (P,), True for points in the largest connected component of their cluster.

    Ties go to the component that starts first in row order. Points that belong to no cluster are True.
    """
    return in_near_pieces(clusters, frame, connection, min_ratio=LARGEST_ONLY, max_slope=0.0)


def in_near_pieces(
    clusters: PointClusters, frame: Frame, connection: Connection, min_ratio: float, max_slope: float
) -> Bool:
    """Return an array (P,), True for points in their cluster's largest component, or in one at a similar depth.

    Candidates are components with at least `min_ratio` times the points of the largest component, largest first. A
    candidate is kept if most of its points agree in depth with the nearest kept point. The allowed difference is the
    gap of `connection` plus `max_slope` (m per m) times the lateral distance. Large components are subsampled. Points
    that belong to no cluster are True.
    """
    order, firsts = members(clusters)
    stays = np.empty(firsts[-1], np.bool_)
    find_pieces(
        clusters.pixels[order], firsts, frame.depth, connection, np.float32(min_ratio),
        np.float32(max_slope / frame.camera.fx), thread_schedule(np.diff(firsts)), stays,
    )  # fmt: skip
    kept = np.ones(len(clusters.cluster), np.bool_)
    kept[order] = stays
    return kept
