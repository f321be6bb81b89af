"""Hierarchical Gaussian mixtures: trees over many point sets, grown level by level in parallel.

The method follows Eckart, Kim, Troccoli, Kelly and Kautz, "Accelerated Generative Models for 3D Point Cloud Data", CVPR
2016. Every node is a small mixture of its own points, and a point descends only to its best child. With J children per
node, a level costs J Gaussians per point; a flat mixture with as many components costs J^level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.mixture_kernels import BLOCK, EmSettings, Mixtures, coefficients
from framework.refinement.mixtures.mixture_tree_kernels import bounding_boxes, cut_all, pass_down, set_own_ratios
from framework.refinement.neighborhood import Neighborhoods
from framework.refinement.neighborhood_kernels import grouped


@dataclass(frozen=True)
class Level:
    """M nodes of one level, below the Q nodes of the level above; for the first level, Q is the number of trees.

    The children of node q are the rows `firsts[q]:firsts[q + 1]`. A node without children is a leaf. Weights are
    fractions of the whole tree: a node's weight is the sum over its children and their uniform component.
    """

    weights: Float64  # (M,) pi, above 0
    means: Float64  # (M, 3) mu, m
    covariances: Float64  # (M, 3, 3) Sigma, m^2
    firsts: Int64  # (Q + 1,) start of the children of each node
    outlier_weights: Float64  # (Q,) pi of the uniform component among the children of node q; 0 for a leaf
    outlier_boxes: Float64  # (Q, 2, 3) m, minimum and maximum corner of the uniform component's box

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def parents(self) -> Int64:
        """Parent (M,) of each node in the level above; at the first level, its tree."""
        return np.repeat(np.arange(len(self.firsts) - 1), np.diff(self.firsts))

    @property
    def outlier_densities(self) -> Float64:
        """Density (Q,) of the uniform component, 1 / m^3; 0 for a leaf."""
        volumes = np.prod(self.outlier_boxes[:, 1] - self.outlier_boxes[:, 0], axis=1)
        return np.asarray(np.where(volumes > 0, 1.0 / np.where(volumes > 0, volumes, 1.0), 0.0), np.float64)


@dataclass(frozen=True)
class MixtureTree:
    """The trees of N point sets."""

    levels: tuple[Level, ...]  # coarsest first; at least one

    def best_nodes(self, k: int, points: Float32, starts: Int64) -> Int64:
        """Return the best node (S,) of level `k` for each of S points; -1 = the uniform component is more likely.

        `points[starts[q]:starts[q + 1]]`, m, are the points of node q of the level above. The best node of a point is
        the child of its node with the largest weighted density.
        """
        ratios, outlier_ratios = np.ones(len(self.levels[k]), np.float32), np.ones(len(starts) - 1, np.float32)
        log_odds = np.zeros(len(points), np.float32)
        return self.best_nodes_with_posteriors(k, points, starts, ratios, outlier_ratios, log_odds)[0]

    def best_nodes_with_posteriors(
        self, k: int, points: Float32, starts: Int64, ratios: Float32, outlier_ratios: Float32, log_odds: Float32
    ) -> tuple[Int64, Float32]:
        """Return the best node (S,) of each point, as in `best_nodes`, and the posterior (S,) of the object.

        The posterior uses the densities of level `k`. `ratios` (M,) are the object's fractions of the nodes' densities,
        and `outlier_ratios` (Q,) are its fractions of the uniform components. `log_odds` (S,): the object's density at
        a point is multiplied by exp(log_odds). The posterior is 0 if the point's node in the level above is a leaf.
        """
        level = self.levels[k]
        child, posterior = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
        rows = coefficients(level.weights, level.means, level.covariances)
        log_outliers = mixture.log_densities_of(level.outlier_weights * level.outlier_densities)
        pass_down(
            points, log_odds, mixture.blocks_of(starts[:-1], starts[1:], BLOCK), rows, ratios, level.firsts,
            log_outliers, outlier_ratios, child, posterior,
        )  # fmt: skip
        return child, posterior


def fit(
    points: Float32, starts: Int64, settings: EmSettings, *, levels: int, children: int, min_support: float,
    min_points: int,
) -> MixtureTree:  # fmt: skip
    """Grow a tree of at most `levels` levels over each point set `points[starts[k]:starts[k + 1]]`.

    A node with at least `min_points` points gets `children` children, fitted to its points by `mixture.fit` with the
    labels of `cut`. Each point then descends to its best child, or remains at the node if the uniform component is more
    likely. A child with a weight below `min_support` is dropped in favor of its siblings. A set with too few points has
    no nodes.
    """
    grown: list[Level] = []
    above = np.ones(len(starts) - 1)  # weights of the points' current nodes
    least_side = 4 * np.sqrt(settings.variance_floor)
    for _ in range(levels):
        chosen = np.nonzero(np.diff(starts) >= max(min_points, 1))[0]
        if grown and len(chosen) == 0:
            break
        own, own_starts = ranges(points, starts, chosen)
        fitted = mixture.fit(own, own_starts, cut(own, own_starts, children), children, settings)
        level = level_below(fitted, bounding_boxes(own, own_starts, least_side), chosen, above, min_support)
        if grown and len(level) == 0:
            break
        grown.append(level)
        if len(grown) < levels:
            child = MixtureTree((level,)).best_nodes(0, points, starts)
            order, starts = grouped(child.astype(np.int32), len(level))
            points, above = points[order], level.weights
    return MixtureTree(tuple(grown))


def cut(points: Float32, starts: Int64, groups: int) -> Int32:
    """Return labels (S,) in [0, groups) that divide each set into compact groups, to initialize `mixture.fit`.

    Set k is `points[starts[k]:starts[k + 1]]`, m. Variance-based bisection cuts the group with the largest scatter
    along one axis at its mean. A group is not cut if one part would have too few points for a component.
    """
    labels = np.zeros(len(points), np.int32)
    cut_all(points, starts, groups, labels)
    return labels


def own_ratios(log_odds: Float32, starts: Int64, above: Float32, above_points: float) -> Float32:
    """Return the object's fraction (M,) of the density of each node j.

    `log_odds[starts[j]:starts[j + 1]]` are the log-likelihood ratios o_i of object to background of the node's points.
    The fraction rho maximizes sum_i log(rho exp(o_i) + 1 - rho). The fraction of the parent, `above` (M,), has the
    weight of `above_points` additional points. rho is computed by EM over the classes of the points.
    """
    ratios = above.astype(np.float32)
    set_own_ratios(log_odds, starts, above_points, ratios)
    return ratios


def object_ratios(tree: MixtureTree, sample: Neighborhoods, odds: Float32, parent_points: float) -> list[Float32]:
    """Return, for each level, the object's fraction (M,) of the density of each of its M nodes; see `own_ratios`.

    `odds`: the log-odds (S,) of the points of `sample` for the object. The fraction of the parent has the weight of
    `parent_points` points. The fraction above the first level is 0.5.
    """
    points, starts = sample.points_camera, sample.starts
    above, ratios = np.full(len(sample), 0.5, np.float32), []
    for k, level in enumerate(tree.levels):
        order, starts = grouped(tree.best_nodes(k, points, starts).astype(np.int32), len(level))
        points, odds = points[order], odds[order]
        above = own_ratios(odds, starts, above[level.parents], parent_points)
        ratios.append(above)
    return ratios


def claimed(tree: MixtureTree, ratios: list[Float32], own: Neighborhoods, odds: Float32, min_posterior: float) -> Bool:
    """Return an array (S,), True for points with a posterior of the object above `min_posterior` at their last level.

    `own`: the S points of the masks. `odds`: their log-odds (S,) for the object. `ratios`: from `object_ratios`. The
    last level of a point is the deepest level with children of its node.
    """
    claimed, remaining = np.zeros(len(own.points_camera), bool), np.arange(len(own.points_camera))
    points, starts = own.points_camera, own.starts
    above = np.zeros(len(own), np.float32)
    for k, level in enumerate(tree.levels):
        child, posterior = tree.best_nodes_with_posteriors(k, points, starts, ratios[k], above, odds)
        claimed[remaining] = posterior > min_posterior
        if k + 1 < len(tree.levels):
            has_children = np.append(np.diff(tree.levels[k + 1].firsts) > 0, False)  # False for -1, an outlier
            order, starts = grouped(np.where(has_children[child], child, -1).astype(np.int32), len(level))
            remaining, points, odds, above = remaining[order], points[order], odds[order], ratios[k]
    return claimed


def level_below(fitted: Mixtures, boxes: Float64, chosen: Int64, above: Float64, min_support: float) -> Level:
    """Return the level below Q nodes with weights `above` (Q,). Only the nodes with indices `chosen` have children.

    `fitted`: their mixtures. `boxes`: the boxes (chosen, 2, 3), m, of their uniform components. A child with a weight
    below `min_support` is dropped.
    """
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
    firsts = np.concatenate([[0], np.cumsum(counts)])
    nodes = (weights * scale[:, None])[kept], fitted.means[kept], fitted.covariances[kept]
    return Level(*nodes, firsts, outlier_weights, outlier_boxes)


def ranges(points: Float32, starts: Int64, chosen: Int64) -> tuple[Float32, Int64]:
    """Return the points of the sets with the ascending indices `chosen`, and the starts (chosen + 1,) of these sets.

    Set k is `points[starts[k]:starts[k + 1]]`.
    """
    counts = np.diff(starts)
    if len(chosen) == len(counts):
        return points, starts
    inside = np.zeros(len(counts), bool)
    inside[chosen] = True
    return points[np.repeat(inside, counts)], np.concatenate([[0], np.cumsum(counts[chosen])])
