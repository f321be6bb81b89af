"""Which nodes of a tree of mixtures are the object's, told by the evidence of the points on them."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Float32
from framework.refinement.mixtures.mixture_tree import MixtureTree, own_shares
from framework.refinement.neighborhood import Neighborhoods
from framework.refinement.neighborhood_kernels import grouped


def object_shares(tree: MixtureTree, sample: Neighborhoods, odds: Float32, parent_points: float) -> list[Float32]:
    """For each level (M,) how much of each node is the object's, by the log-odds (S,) of the sample's points.

    A parent's share counts for `parent_points` points in its children's.
    """
    points, starts = sample.points_camera, sample.starts
    above, shares = np.full(len(sample), 0.5, np.float32), []
    for k, level in enumerate(tree.levels):
        child = tree.passed(k, points, starts)
        order, starts = grouped(child.astype(np.int32), len(level))
        points, odds = points[order], odds[order]
        above = own_shares(odds, starts, above[level.parents], parent_points)
        shares.append(above)
    return shares


def claimed(tree: MixtureTree, shares: list[Float32], own: Neighborhoods, odds: Float32, min_posterior: float) -> Bool:
    """(S,) which of the masks' points the object claims with more than `min_posterior`.

    Each level overrules the one above; `odds` (S,) are the points' own log-odds.
    """
    ours, left = np.zeros(len(own.points_camera), bool), np.arange(len(own.points_camera))
    points, starts = own.points_camera, own.starts
    above = np.zeros(len(own), np.float32)
    for k, level in enumerate(tree.levels):
        child, share = tree.shared(k, points, starts, shares[k], above, odds)
        ours[left] = share > min_posterior
        if k + 1 < len(tree.levels):
            goes_on = np.append(np.diff(tree.levels[k + 1].firsts) > 0, False)  # -1, an outlier, ends here
            key = np.where(goes_on[child], child, -1)
            order, starts = grouped(key.astype(np.int32), len(level))
            left, points, odds, above = left[order], points[order], odds[order], shares[k]
    return ours
