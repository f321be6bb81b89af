"""Pieces of a cluster that are connected in the image and in depth.

OpenCV and SciPy label binary images, without depth and only adjacent pixels; a graph of all near pairs takes 12 edges
per point.
"""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Frame, PointClusters
from framework.refinement.connected_pieces_kernels import Connection, find_pieces
from framework.refinement.neighborhood import members, thread_schedule

LARGEST_ONLY = 2.0  # min_ratio that no other piece has


def in_largest_piece(clusters: PointClusters, frame: Frame, connection: Connection) -> Bool:
    """Return (P,) which points are in their cluster's largest connected piece, of equal ones the first in the image.

    Points of no cluster are in.
    """
    return in_near_pieces(clusters, frame, connection, min_ratio=LARGEST_ONLY, max_slope=0.0)


def in_near_pieces(
    clusters: PointClusters, frame: Frame, connection: Connection, min_ratio: float, max_slope: float
) -> Bool:
    """Return (P,) which points are in their cluster's largest piece, or in a piece at a similar depth.

    Candidates are pieces with at least `min_ratio` of the largest one's points, in order of size. A candidate is kept
    if most of its points differ in depth from the nearest kept point by at most the gap plus `max_slope` (m per m)
    times the distance across. Large pieces are sampled.
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
