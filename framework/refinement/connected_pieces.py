"""Connected components of a cluster in the image and in depth.

OpenCV and SciPy label binary images: they ignore depth and connect only adjacent pixels.
"""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Frame, PointClusters
from framework.refinement.connected_pieces_kernels import Connection, find_pieces
from framework.refinement.neighborhood import members, thread_schedule

LARGEST_ONLY = 2.0  # min_ratio that only the largest component satisfies


def in_largest_piece(clusters: PointClusters, frame: Frame, connection: Connection) -> Bool:
    """Return a Boolean array (P,), True for the points in the largest connected component of their cluster.

    If two components are equally large, the first in row order is used. Points that belong to no cluster are True.
    """
    return in_near_pieces(clusters, frame, connection, min_ratio=LARGEST_ONLY, max_slope=0.0)


def in_near_pieces(
    clusters: PointClusters, frame: Frame, connection: Connection, min_ratio: float, max_slope: float
) -> Bool:
    """Return a Boolean array (P,), True for the points in the components of their cluster that are kept.

    The largest component is kept, and so are components at a similar depth. A component is at a similar depth if most
    of its points agree in depth with the nearest kept point. Points that belong to no cluster are True.

    Args:
        clusters: The clusters.
        frame: The frame.
        connection: The limits of the distance between connected points.
        min_ratio: The minimum size of a kept component, relative to the largest component.
        max_slope: The allowed change of depth with lateral distance between components, m per m.
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
