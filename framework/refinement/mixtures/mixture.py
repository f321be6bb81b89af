"""Gaussian mixtures with a uniform outlier component, fitted to many point sets in parallel.

The method is expectation maximization, eqs. (1) to (4) of docs/method.md. The uniform component follows Eckart et al.,
"Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016. The mixtures of scikit-learn are slower and have no
uniform component.
"""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures.gaussian import ABSENT
from framework.refinement.mixtures.mixture_kernels import (
    BLOCK,
    Blocks,
    EmSettings,
    Mixtures,
    claim,
    coefficients,
    fit_all,
    improve_all,
)

BATCH = 16 * BLOCK  # maximum number of points that a thread processes at once


def fit(
    points: Float32, starts: Int64, labels: Int32, components: int, settings: EmSettings, *,
    prior_log_odds: Float32 | None = None, own_components: int = 1,
) -> Mixtures:  # fmt: skip
    """Fit a mixture to each set of points by expectation maximization.

    The uniform component covers the bounding box of the set.

    Args:
        points: The points (S, 3) of all sets, m.
        starts: The start (N + 1,) of each set in `points`.
        labels: The initial component (S,) of each point.
        components: The number of components of each mixture.
        settings: The settings of expectation maximization.
        prior_log_odds: The log-odds (S,) of each point for the first `own_components`; None = 0. They scale the
            densities of these components, so that log-likelihoods are defined only up to a constant.
        own_components: The number of components that `prior_log_odds` refers to.
    """
    n = len(starts) - 1
    shape, odds = (n, components), _zeros_if_none(prior_log_odds, points)
    mixtures = Mixtures(
        np.zeros(shape), np.zeros((*shape, 3)), np.zeros((*shape, 3, 3)), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros(n, np.int64),
    )  # fmt: skip
    fit_all(points, starts, labels, odds, own_components, settings, mixtures)
    return mixtures


def improve(points: Float32, starts: Int64, mixtures: Mixtures, settings: EmSettings) -> None:
    """Run expectation maximization on each set of points, starting from the current mixtures.

    Args:
        points: The points (S, 3) of all sets, m.
        starts: The start (N + 1,) of each set in `points`.
        mixtures: The mixtures, modified in place.
        settings: The settings of expectation maximization.
    """
    improve_all(points, starts, np.zeros(len(points), np.float32), settings, mixtures)


def likely_members(
    points: Float32, begins: Int64, ends: Int64, mixtures: Mixtures, *, own_components: int, min_posterior: float,
    prior_log_odds: Float32 | None = None,
) -> Bool:  # fmt: skip
    """Return a Boolean array (S,), True for points that belong to the object with a high posterior probability.

    The first `own_components` of each mixture are the object. If a mixture has no components, its points are True.
    Points outside the sets are False.

    Args:
        points: The points (S, 3), m.
        begins: The start (N,) of each set in `points`.
        ends: The end (N,) of each set in `points`.
        mixtures: The mixture of each set.
        own_components: The number of components of the object.
        min_posterior: The minimum posterior probability.
        prior_log_odds: The log-odds (S,) of each point for the object, as in fit(); None = 0.
    """
    weights, means, covariances = mixtures.weights, mixtures.means, mixtures.covariances
    rows = coefficients(weights.ravel(), means.reshape(-1, 3), covariances.reshape(-1, 3, 3))
    log_outliers = log_densities_of(mixtures.outlier_weights * mixtures.outlier_densities)
    odds, claimed = _zeros_if_none(prior_log_odds, points), np.zeros(len(points), np.bool_)
    claim(
        points, blocks_of(begins, ends, BATCH), odds, rows.reshape(*weights.shape, 10), log_outliers, own_components,
        min_posterior, claimed,
    )  # fmt: skip
    return claimed


def blocks_of(begins: Int64, ends: Int64, size: int) -> Blocks:
    """Return blocks of at most `size` points that cover the given ranges of points."""
    counts = -(-(ends - begins) // size)
    owner = np.repeat(np.arange(len(counts)), counts)
    firsts = begins[owner] + size * (np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts))
    return Blocks(owner, firsts, np.minimum(firsts + size, ends[owner]))


def log_densities_of(densities: Float64) -> Float32:
    """Return the logarithm of densities, or ABSENT for densities of 0."""
    return np.where(densities > 0, np.log(np.maximum(densities, 1e-300)), ABSENT).astype(np.float32)


def _zeros_if_none(odds: Float32 | None, points: Float32) -> Float32:
    return np.zeros(len(points), np.float32) if odds is None else odds
