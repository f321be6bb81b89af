"""Density of a mixture tree in plain NumPy."""

from __future__ import annotations

import numpy as np

from framework.refinement.mixtures.mixture_tree import MixtureTree


def gaussian_densities(points: np.ndarray, weights: np.ndarray, means: np.ndarray, Sigmas: np.ndarray) -> np.ndarray:
    """Return the density (S, K) of each weighted Gaussian at each point."""
    whitened = (points - means[:, None]) @ np.linalg.inv(np.linalg.cholesky(Sigmas)).transpose(0, 2, 1)  # (K, S, 3)
    scales = weights / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(Sigmas))
    return (np.exp(-0.5 * (whitened**2).sum(axis=-1)) * scales[:, None]).T


def leaves(tree: MixtureTree, depth: int) -> list[tuple[int, np.ndarray]]:
    """Return the leaves of the trees, which are cut below `depth` levels, as pairs of a level and its rows."""
    rows = []
    for k in range(min(depth, len(tree.levels))):
        last = k + 1 in (depth, len(tree.levels))
        childless = np.ones(len(tree.levels[k]), bool) if last else np.diff(tree.levels[k + 1].firsts) == 0
        rows.append((k, np.nonzero(childless)[0]))
    return rows


def owners(tree: MixtureTree, k: int) -> np.ndarray:
    """Return the tree (M,) to which each node of level `k` belongs."""
    found = tree.levels[0].parents
    for level in tree.levels[1 : k + 1]:
        found = found[level.parents]
    return found


def log_likelihoods(tree: MixtureTree, points: np.ndarray, starts: np.ndarray, depth: int | None = None) -> np.ndarray:
    """Return the mean log-likelihood (N,), nats, of each point set under the first `depth` levels.

    The density is the sum over all leaves and uniform components. The result is 0 for a set without points, and -inf if
    the density is zero at a point.
    """
    depth = len(tree.levels) if depth is None else depth
    means = np.zeros(len(starts) - 1)
    for k in range(len(means)):
        own = points[starts[k] : starts[k + 1]].astype(np.float64)
        density = np.zeros(len(own))
        for level, rows in leaves(tree, depth):
            rows = rows[owners(tree, level)[rows] == k]
            part = tree.levels[level]
            density += gaussian_densities(own, part.weights[rows], part.means[rows], part.covariances[rows]).sum(axis=1)
        for level in range(depth):
            above, part = owners(tree, level - 1) if level else np.arange(len(means)), tree.levels[level]
            for q in np.nonzero((above == k) & (part.outlier_weights > 0))[0]:
                low, high = part.outlier_boxes[q]
                inside = ((own >= low) & (own <= high)).all(axis=1)
                density += inside * part.outlier_weights[q] / np.prod(high - low)
        with np.errstate(divide="ignore"):
            means[k] = np.log(density).mean() if len(own) else 0.0
    return means
