"""Pieces of a cluster that are connected in the image and in depth.

Pixels up to some rows apart are connected where their depths agree, for which no library has a kernel: OpenCV and SciPy
label binary images, and a graph of all near pairs takes 12 edges a point.
"""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Frame, PointClusters
from framework.refinement.connected_pieces_kernels import find_pieces
from framework.refinement.neighborhood import members, thread_shares

NO_OTHER = 2.0  # min_share that no piece beside the largest has


def in_largest_piece(clusters: PointClusters, frame: Frame, gap: float, gap_per_depth: float, reach: int) -> Bool:
    """(P,) which points are in their cluster's largest connected piece, of equals the one seen first in the image.

    Two points are connected when they are at most `reach` px apart and their depths differ by less than `gap` (m) +
    `gap_per_depth` * depth of the nearer one. Points of no cluster are in.
    """
    return in_near_pieces(clusters, frame, gap, gap_per_depth, reach, min_share=NO_OTHER, steepest=0.0)


def in_near_pieces(
    clusters: PointClusters,
    frame: Frame,
    gap: float,
    gap_per_depth: float,
    reach: int,
    min_share: float,
    steepest: float,
) -> Bool:
    """(P,) which points are in their cluster's largest piece, or in one that no large step parts from what stays.

    Pieces are those of `in_largest_piece`. Those with `min_share` of the largest one's points or more are gone through,
    larger ones first. One stays when most of its points differ in depth from the nearest one that stays by no more than
    the gap, and what a surface may rise on the way there: `steepest` m of depth a metre aside. By samples.
    """
    order, firsts = members(clusters)
    stays = np.empty(firsts[-1], np.bool_)
    find_pieces(
        clusters.pixels[order], firsts, frame.depth, np.float32(gap), np.float32(gap_per_depth), reach,
        np.float32(min_share), np.float32(steepest / frame.camera.fx), *thread_shares(np.diff(firsts)), stays,
    )  # fmt: skip
    kept = np.ones(len(clusters.cluster), np.bool_)
    kept[order] = stays
    return kept
