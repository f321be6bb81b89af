"""Hierarchical Gaussian mixtures: a tree over each of many point sets, all grown level by level at the same time.

After Eckart, Kim, Troccoli, Kelly and Kautz, "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016: every
node is a small mixture of its own points, and a point goes down to its best child alone. A level of J children a node
then costs J Gaussians a point, where a flat mixture of as many components costs J^level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.gaussian import (
    ABSENT,
)
from framework.refinement.mixtures.mixture_kernels import BLOCK
from framework.refinement.mixtures.mixture_tree_kernels import (
    bounding_boxes,
    cut_all,
    pass_down,
    set_all_coefficients,
    share_all,
)
from framework.refinement.neighborhood_kernels import grouped


@dataclass(frozen=True)
class Level:
    """M nodes of one level, below the Q nodes of the level above; above the first level are the N trees themselves.

    Siblings lie together: the children of node q are the rows `firsts[q]:firsts[q + 1]`. A node without children is a
    leaf. Weights are shares of the whole tree: those of a node's children and of the uniform component beside them
    sum to its own.
    """

    weights: Float64  # (M,) pi, above 0
    means: Float64  # (M, 3) mu, m
    covariances: Float64  # (M, 3, 3) Sigma, m^2
    firsts: Int64  # (Q + 1,)
    outlier_weights: Float64  # (Q,) pi of the uniform component among the children of node q; 0 for a leaf
    outlier_boxes: Float64  # (Q, 2, 3) m, lowest and highest corner of the box that it fills

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def parents(self) -> Int64:
        """(M,) the parent of each node: a node of the level above, at the first level a tree."""
        return np.repeat(np.arange(len(self.firsts) - 1), np.diff(self.firsts))

    @property
    def outlier_densities(self) -> Float64:
        """(Q,) of the uniform component within its box, 1 / m^3; 0 for a leaf, which has none."""
        volumes = np.prod(self.outlier_boxes[:, 1] - self.outlier_boxes[:, 0], axis=1)
        return np.asarray(np.where(volumes > 0, 1.0 / np.where(volumes > 0, volumes, 1.0), 0.0), np.float64)


@dataclass(frozen=True)
class MixtureTree:
    """The trees of N point sets."""

    levels: tuple[Level, ...]  # from the coarsest; at least one

    def passed(self, k: int, points: Float32, starts: Int64) -> Int64:
        """(S,) the best node of level `k` for each point; -1 = the uniform component is likelier than each of them.

        `points[starts[q]:starts[q + 1]]` have come down to node q of the level above.
        """
        nodes, ones, odds = np.ones(len(self.levels[k])), np.ones(len(starts) - 1), np.zeros(len(points))
        child, _ = self.shared(
            k, points, starts, nodes.astype(np.float32), ones.astype(np.float32), odds.astype(np.float32)
        )
        return child

    def shared(
        self, k: int, points: Float32, starts: Int64, shares: Float32, above: Float32, log_odds: Float32
    ) -> tuple[Int64, Float32]:
        """`passed`, and (S,) in [0, 1] how much of each point is ours by the densities of this level.

        A node is ours by its share in `shares` (M,), the uniform component below node q by `above[q]` (Q,). Our part
        of the density is multiplied by exp(`log_odds`) (S,). A point at a leaf is not ours.
        """
        level = self.levels[k]
        child, share = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
        pass_down(
            points, log_odds, *_blocks(starts), _coefficients_of(level), shares, level.firsts, _log_outliers(level),
            above, child, share,
        )  # fmt: skip
        return child, share


def fit(
    points: Float32,
    starts: Int64,
    *,
    levels: int,
    children: int,
    max_iterations: int,
    tolerance: float,
    variance_floor: float,
    outlier_fraction: float,
    min_support: float,
    min_points: int,
) -> MixtureTree:
    """Grows a tree of at most `levels` levels over each point set `points[starts[k]:starts[k + 1]]`.

    A node with `min_points` points or more gets `children` of its own, fitted to its points by `mixture.fit`, which
    `max_iterations`, `tolerance`, `variance_floor` (m^2) and `outlier_fraction` are for, from the start that `cut`
    makes. Each point then goes to its best child; one that the uniform component explains best goes no deeper. A child
    that weighs less than `min_support` in its tree is dropped, to its siblings' gain. A set with too few points has no
    nodes at all.
    """
    grown: list[Level] = []
    above = np.ones(len(starts) - 1)  # weights of the nodes that the points are at
    for _ in range(levels):
        chosen = np.nonzero(np.diff(starts) >= max(min_points, 1))[0]
        if grown and len(chosen) == 0:
            break
        own, own_starts = _ranges(points, starts, chosen)
        fitted = mixture.fit(
            own,
            own_starts,
            cut(own, own_starts, children),
            children,
            max_iterations=max_iterations,
            tolerance=tolerance,
            variance_floor=variance_floor,
            outlier_fraction=outlier_fraction,
        )
        boxes = bounding_boxes(own, own_starts, 4 * np.sqrt(variance_floor))
        level = _level(fitted, boxes, chosen, above, min_support)
        if grown and len(level) == 0:
            break
        grown.append(level)
        if len(grown) < levels:
            child = MixtureTree((level,)).passed(0, points, starts)
            order, starts = grouped(child.astype(np.int32), len(level))
            points, above = points[order], level.weights
    return MixtureTree(tuple(grown))


def cut(points: Float32, starts: Int64, groups: int) -> Int32:
    """(S,) each set cut into at most `groups` groups in [0, groups) that lie together: a start for `mixture.fit`.

    The group of the largest scatter along one axis is cut in two at its mean, again and again (variance-based
    bisection). A group that a cut would leave with too few points for a component stays whole.
    """
    labels = np.zeros(len(points), np.int32)
    cut_all(points, starts, groups, labels)
    return labels


def own_shares(log_odds: Float32, starts: Int64, above: Float32, above_points: float) -> Float32:
    """(M,) the share of each node that is ours, from the evidence `log_odds[starts[j]:starts[j + 1]]` of its points.

    Each point is ours or not; its evidence is the log-likelihood ratio of the two. The share rho is the likeliest one,
    max sum_i log(rho exp(o_i) + 1 - rho), as if `above_points` more points shared the parent's share `above` (M,): the
    fixed point of EM over the points' sides.
    """
    shares = above.astype(np.float32)
    share_all(log_odds, starts, above_points, shares)
    return shares


def _level(fitted: mixture.Mixtures, boxes: Float64, chosen: Int64, above: Float64, min_support: float) -> Level:
    """The level below nodes of the weights `above` (Q,), of which the `chosen` ones have been given children."""
    kept = (fitted.weights > 0) & (fitted.weights * above[chosen, None] >= min_support)
    survivors = np.count_nonzero(kept, axis=1)
    weights = np.where(kept, fitted.weights, 0.0)
    outliers = np.where(survivors > 0, fitted.outlier_weights, 0.0)
    totals = weights.sum(axis=1) + outliers
    scale = above[chosen] / np.where(totals > 0, totals, 1.0)
    counts, outlier_weights = np.zeros(len(above), np.int64), np.zeros(len(above))
    outlier_boxes = np.zeros((len(above), 2, 3))
    counts[chosen] = survivors
    outlier_weights[chosen] = outliers * scale
    outlier_boxes[chosen] = np.where((survivors > 0)[:, None, None], boxes, 0.0)
    return Level(
        weights=(weights * scale[:, None])[kept],
        means=fitted.means[kept],
        covariances=fitted.covariances[kept],
        firsts=np.concatenate([[0], np.cumsum(counts)]),
        outlier_weights=outlier_weights,
        outlier_boxes=outlier_boxes,
    )


def _ranges(points: Float32, starts: Int64, chosen: Int64) -> tuple[Float32, Int64]:
    """The points of the chosen sets alone, and where each of them begins."""
    counts = np.diff(starts)
    if len(chosen) == len(counts):
        return points, starts
    inside = np.zeros(len(counts), bool)
    inside[chosen] = True
    return points[np.repeat(inside, counts)], np.concatenate([[0], np.cumsum(counts[chosen])])


def _coefficients_of(level: Level) -> Float32:
    """(M, 10) the rows that `log_densities` takes."""
    rows = np.zeros((len(level), 10), np.float32)
    set_all_coefficients(level.weights, level.means, level.covariances, rows)
    return rows


def _log_outliers(level: Level) -> Float32:
    """(Q,) log(pi p) of the uniform components within their boxes, ABSENT where there is none."""
    evidence = level.outlier_weights * level.outlier_densities
    return np.where(evidence > 0, np.log(np.maximum(evidence, 1e-300)), ABSENT).astype(np.float32)


def _blocks(starts: Int64) -> tuple[Int64, Int64, Int64]:
    """Each set in blocks for the kernels: (B,) the set, where the block begins and where it ends."""
    blocks = -(-np.diff(starts) // BLOCK)
    sets = np.repeat(np.arange(len(blocks)), blocks)
    begins = starts[sets] + BLOCK * (np.arange(len(sets)) - np.repeat(np.cumsum(blocks) - blocks, blocks))
    return sets, begins, np.minimum(begins + BLOCK, starts[sets + 1])
