"""Which points leave their clusters for lying on a plane that bounds the scene."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, PointClusters, UInt8
from framework.refinement.segmentation.plane_points_kernels import find_off_planes
from framework.refinement.selection_kernels import PART


def off_planes(clusters: PointClusters, on_plane: UInt8, planes: int, max_own: float) -> tuple[Bool, Bool]:
    """(P,) which points stay; (H, W) which pixels are on a plane, and not in a cluster that keeps it.

    `on_plane` (H, W) has 1 + the plane of each reading, 0 = none. A cluster loses those planes of which it holds at
    most `max_own` of the readings.
    """
    structure = on_plane > 0
    rows = len(clusters) + 1  # the last is for points of no cluster
    counts = np.zeros((-(-len(clusters.cluster) // PART), rows, planes + 1), np.int64)
    stays = np.ones((rows, planes + 1), np.bool_)
    kept = find_off_planes(clusters.cluster, clusters.pixels, on_plane, max_own, counts, stays, structure)
    return kept, structure
