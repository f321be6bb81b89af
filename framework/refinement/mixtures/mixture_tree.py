"""Trees of Gaussian mixtures over many point sets.

The method follows Eckart et al., "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016. Every node is a
small mixture of its own points, and each point descends only to its best child. This is much faster than a flat mixture
with as many components.
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
    """The M nodes of one level, and their relation to the Q nodes of the level above.

    The children of node q are the rows `firsts[q]:firsts[q + 1]`. A node without children is a leaf. Weights are
    fractions of the whole tree. The first level is below the root of each tree.
    """

    weights: Float64  # (M,) pi, above 0
    means: Float64  # (M, 3) mu, m
    covariances: Float64  # (M, 3, 3) Sigma, m^2
    firsts: Int64  # (Q + 1,) start of the children of each node
    outlier_weights: Float64  # (Q,) pi of the uniform component among the children of node q; 0 for a leaf
    outlier_boxes: Float64  # (Q, 2, 3) m, minimum and maximum corner of the box of the uniform component

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def parents(self) -> Int64:
        """Parent (M,) of each node in the level above."""
        return np.repeat(np.arange(len(self.firsts) - 1), np.diff(self.firsts))

    @property
    def outlier_densities(self) -> Float64:
        """Density (Q,) of the uniform component, 1 / m^3, 0 for a leaf."""
        volumes = np.prod(self.outlier_boxes[:, 1] - self.outlier_boxes[:, 0], axis=1)
        return np.asarray(np.where(volumes > 0, 1.0 / np.where(volumes > 0, volumes, 1.0), 0.0), np.float64)


@dataclass(frozen=True)
class MixtureTree:
    """The trees of N point sets."""

    levels: tuple[Level, ...]  # coarsest first; at least one

    def best_nodes(self, k: int, points: Float32, starts: Int64) -> Int64:
        """Return the best node (S,) of level k for each point.

        The best node of a point is the child of its current node with the largest weighted density. The result is -1 if
        the uniform component is more likely, or if the current node is a leaf.

        Args:
            k: The index of the level.
            points: The points (S, 3), sorted by their node in the level above, m.
            starts: The start (Q + 1,) of the points of each node in the level above.
        """
        ratios, outlier_ratios = np.ones(len(self.levels[k]), np.float32), np.ones(len(starts) - 1, np.float32)
        log_odds = np.zeros(len(points), np.float32)
        return self.best_nodes_with_posteriors(k, points, starts, ratios, outlier_ratios, log_odds)[0]

    def best_nodes_with_posteriors(
        self, k: int, points: Float32, starts: Int64, ratios: Float32, outlier_ratios: Float32, log_odds: Float32
    ) -> tuple[Int64, Float32]:
        """Return the best node (S,) of each point, and its posterior probability (S,) for the object.

        The posterior is 0 if the node of the point in the level above is a leaf.

        Args:
            k: The index of the level.
            points: The points (S, 3), sorted by their node in the level above, m.
            starts: The start (Q + 1,) of the points of each node in the level above.
            ratios: The object fraction (M,) of the density of each node.
            outlier_ratios: The object fraction (Q,) of each uniform component.
            log_odds: The log-odds (S,) of each point for the object.
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
    """Fit a tree of mixtures to each set of points.

    A node with enough points gets children, which are fitted to its points. Each point then descends to its best child,
    or remains at the node if the uniform component is more likely. A set with too few points has no nodes.

    Args:
        points: The points (S, 3) of all sets, m.
        starts: The start (N + 1,) of each set in `points`.
        settings: The settings of expectation maximization.
        levels: The maximum number of levels.
        children: The number of children of a node.
        min_support: The minimum weight of a child. Children with less weight are removed.
        min_points: The minimum number of points of a node with children.
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
    """Divide each set of points into compact groups, and return their labels (S,).

    The labels initialize expectation maximization. The group with the largest scatter along one axis is cut at its
    mean, until there are enough groups. A group is not cut if one part would have too few points for a component.

    Args:
        points: The points (S, 3) of all sets, m.
        starts: The start (N + 1,) of each set in `points`.
        groups: The number of groups of each set.
    """
    labels = np.zeros(len(points), np.int32)
    cut_all(points, starts, groups, labels)
    return labels


def own_ratios(log_odds: Float32, starts: Int64, above: Float32, above_points: float) -> Float32:
    """Return the object fraction (M,) of the density of each node.

    The fraction is the maximum-likelihood estimate from the points of the node, with the fraction of its parent as a
    prior.

    Args:
        log_odds: The log-odds (S,) of the points for the object, sorted by node.
        starts: The start (M + 1,) of the points of each node.
        above: The object fraction (M,) of the parent of each node.
        above_points: The weight of the prior, in points.
    """
    ratios = above.astype(np.float32)
    set_own_ratios(log_odds, starts, above_points, ratios)
    return ratios


def object_ratios(tree: MixtureTree, sample: Neighborhoods, odds: Float32, parent_points: float) -> list[Float32]:
    """Return, for each level, the object fraction (M,) of the density of each node.

    See own_ratios().

    Args:
        tree: The trees.
        sample: The points of the masks and their rings.
        odds: The log-odds (S,) of the points for the object.
        parent_points: The weight of the prior, in points. The prior of the first level is 0.5.
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
    """Return a Boolean array (S,), True for points that belong to the object with a high posterior probability.

    The posterior is computed at the deepest level that the point reaches.

    Args:
        tree: The trees.
        ratios: The object fractions, from object_ratios().
        own: The points of the masks.
        odds: The log-odds (S,) of the points for the object.
        min_posterior: The minimum posterior probability.
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
    """Return the level below nodes with the given weights (Q,).

    Args:
        fitted: The mixtures of the nodes that get children.
        boxes: The boxes (chosen, 2, 3) of their uniform components, m.
        chosen: The indices of these nodes. All other nodes become leaves.
        above: The weights (Q,) of all nodes.
        min_support: The minimum weight of a child. Children with less weight are removed.
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
    """Return the points of the chosen sets, and the start (chosen + 1,) of each of these sets.

    Args:
        points: The points of all sets.
        starts: The start of each set in `points`.
        chosen: The ascending indices of the chosen sets.
    """
    counts = np.diff(starts)
    if len(chosen) == len(counts):
        return points, starts
    inside = np.zeros(len(counts), bool)
    inside[chosen] = True
    return points[np.repeat(inside, counts)], np.concatenate([[0], np.cumsum(counts[chosen])])
