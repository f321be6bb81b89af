"""Tree of Gaussian mixtures over all masks of a frame.

This is our first interpretation of section 3.2.2 of the paper. The first level has one Gaussian per mask, which is
fitted with the points of the mask as initial responsibilities. Every further level splits each node into children,
which are fitted to the points of the node. A point belongs to the mask of its most probable leaf. The paper names a
hierarchical EM algorithm, but neither the split nor the number of levels.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.frame_tree_kernels import find_most_probable
from framework.refinement.mixtures.lloyd_iterations import cluster
from framework.refinement.mixtures.mixture_kernels import EmSettings, Mixtures, coefficients
from framework.refinement.mixtures.mixture_tree import Level, MixtureTree, cut, level_below, ranges
from framework.refinement.neighborhood_kernels import grouped

NOWHERE = 1e6  # coordinates of the center of a mask without points, m
MIN_SPLIT_POINTS = 32  # minimum number of points of a node to be split


class Initialization(Enum):
    """Initial responsibilities of the Gaussians of the first level."""

    MASKS = "masks, our interpretation of the paper"
    K_MEANS = "k-means over the frame's points, started at the masks' means, the usual method"


@dataclass(frozen=True)
class FrameTree:
    """A tree of Gaussians over the points of N masks."""

    levels: tuple[Level, ...]
    masks: tuple[Int64, ...]  # for each level, the mask (M,) of each of its M nodes

    def leaves(self) -> tuple[Float64, Float64, Float64, Int64]:
        """Return the weights (L,), means (L, 3), m, covariances (L, 3, 3), m^2, and masks (L,) of the leaves."""
        parts = []
        for k, (level, masks) in enumerate(zip(self.levels, self.masks, strict=True)):
            below = self.levels[k + 1].firsts if k + 1 < len(self.levels) else np.zeros(len(level) + 1, np.int64)
            leaf = np.diff(below) == 0
            parts.append((level.weights[leaf], level.means[leaf], level.covariances[leaf], masks[leaf]))
        weights, means, covariances, masks = (np.concatenate(part) for part in zip(*parts, strict=True))
        return weights, means, covariances, masks

    def masks_of(self, points: Float32) -> Int32:
        """Return the mask (S,) of the most probable leaf for each point (S, 3), m, -1 = none."""
        weights, means, covariances, masks = self.leaves()
        best = np.empty(len(points), np.int32)
        find_most_probable(points, coefficients(weights, means, covariances), best)
        return np.append(masks, -1)[best].astype(np.int32)


def grow(
    points: Float32, masks: Int32, count: int, settings: EmSettings, *, levels: int, children: int,
    gaussians_per_mask: int, initialization: Initialization, min_support: float,
) -> FrameTree:  # fmt: skip
    """Fit a tree of Gaussians to the points of a frame.

    Args:
        points: The points (S, 3), m.
        masks: The mask (S,) of each point, in ascending order.
        count: The number of masks.
        settings: The settings of expectation maximization.
        levels: The maximum number of levels.
        children: The number of children of a node: 2, 4 or 8.
        gaussians_per_mask: The number of Gaussians per mask at the first level.
        initialization: The initial responsibilities at the first level.
        min_support: The minimum weight of a node, as a fraction of all points. Nodes with less weight are removed.
    """
    labels = _start(points, masks, count, gaussians_per_mask, initialization, settings.max_iterations)
    components = count * gaussians_per_mask
    starts, all_points = np.array([0, len(points)]), np.zeros(1, np.int64)
    fitted = mixture.fit(points, starts, labels, components, settings)
    level, kept = _level(fitted, all_points, np.ones(1), min_support)
    grown, roots = [level], [kept // gaussians_per_mask]
    for _ in range(1, levels):
        child = MixtureTree((level,)).best_nodes(0, points, starts)
        order, starts = grouped(child.astype(np.int32), len(level))
        points = points[order]
        chosen = np.flatnonzero(np.diff(starts) >= MIN_SPLIT_POINTS)
        if not len(chosen):
            break
        own, own_starts = ranges(points, starts, chosen)
        fitted = corners(level.means[chosen], level.covariances[chosen], children)
        mixture.improve(own, own_starts, fitted, settings)
        parents = roots[-1]
        level, _ = _level(fitted, chosen, level.weights, min_support)
        grown.append(level)
        roots.append(parents[level.parents])
    return FrameTree(tuple(grown), tuple(roots))


def corners(means: Float64, covariances: Float64, children: int) -> Mixtures:
    """Return the initial children of M Gaussians, as M mixtures with equal weights.

    The children are one standard deviation from the mean along the longest principal axes. They have a quarter of the
    covariance.

    Args:
        means: The means (M, 3), m.
        covariances: The covariances (M, 3, 3), m^2.
        children: The number of children of each Gaussian: 2, 4 or 8.
    """
    count, axes = len(means), children.bit_length() - 1
    values, vectors = np.linalg.eigh(covariances)  # ascending
    signs = 1 - 2 * (np.arange(children)[:, None] >> np.arange(axes) & 1)  # (J, axes)
    steps = (np.sqrt(values)[:, None, :] * vectors)[:, :, 3 - axes :]  # (M, 3, axes)
    shape = (count, children)
    return Mixtures(
        weights=np.full(shape, 1 / children),
        means=np.ascontiguousarray(means[:, None] + np.einsum("mxa,ja->mjx", steps, signs)),
        covariances=np.repeat(covariances[:, None] / 4, children, axis=1),
        outlier_weights=np.zeros(count),
        outlier_densities=np.zeros(count),
        log_likelihoods=np.zeros(count),
        iterations=np.zeros(count, np.int64),
    )


def _level(fitted: Mixtures, chosen: Int64, above: Float64, min_support: float) -> tuple[Level, Int64]:
    """Return the level below nodes with the given weights, and the component of each new node in its mixture.

    Only the nodes with indices `chosen` get children.
    """
    boxes = np.zeros((len(chosen), 2, 3))  # without a uniform component
    level = level_below(fitted, boxes, chosen, above, min_support)
    kept = (fitted.weights > 0) & (fitted.weights * above[chosen, None] >= min_support)
    return level, np.nonzero(kept)[1]


def _start(
    points: Float32, masks: Int32, count: int, gaussians: int, initialization: Initialization, max_iterations: int
) -> Int32:
    """Return the index (S,) of the initial Gaussian of each point."""
    starts = np.searchsorted(masks, np.arange(count + 1))
    labels = np.asarray(masks * np.int32(gaussians), np.int32)  # the first Gaussian of each mask
    if gaussians > 1:
        labels += cut(points, starts, gaussians)
    if initialization is Initialization.MASKS:
        return labels
    sizes = np.bincount(labels, minlength=count * gaussians)
    sums = np.stack([np.bincount(labels, points[:, a], count * gaussians) for a in range(3)], axis=1)
    centers = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], NOWHERE)
    return cluster(points, np.array([0, len(points)]), centers[None], max_iterations)[0]
