"""Gaussian mixtures with a uniform outlier component, fitted to many point sets in parallel.

Equations of docs/method.md: (1) the mixture, (2) the E-step, (3, 4) the M-step. The uniform component follows
Eckart et al., "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016. scikit-learn's mixture has no uniform
component and no per-point evidence, and is slower (tests/benchmarks/test_refiners.py).
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
    """Fit a mixture to each point set `points[starts[k]:starts[k + 1]]` by expectation maximization.

    `points`: (S, 3), m. `labels` (S,) in [0, `components`) are hard responsibilities for the first M-step. The uniform
    component covers the set's bounding box.

    `prior_log_odds` (S,) is the evidence of each point for the first `own_components`. Their densities at point i are
    multiplied by exp(prior_log_odds[i]) in eq. (2). The log-likelihood uses the weighted densities, so it is defined
    only up to a constant.
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
    """Run EM in place on each point set `points[starts[k]:starts[k + 1]]`, starting from the current mixture k."""
    improve_all(points, starts, np.zeros(len(points), np.float32), settings, mixtures)


def likely_members(
    points: Float32, begins: Int64, ends: Int64, mixtures: Mixtures, *, own_components: int, min_posterior: float,
    prior_log_odds: Float32 | None = None,
) -> Bool:  # fmt: skip
    """Return an array (S,), True for `points[begins[k]:ends[k]]` with a posterior above `min_posterior` in mixture k.

    The posterior is the probability of the first `own_components`, which form the object. Their densities at point i
    are multiplied by exp(prior_log_odds[i]), as in `fit`; None = 0. For a mixture without components, all entries are
    True, because there is no evidence against the points. Entries outside the ranges are False.
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
    """Return blocks of at most `size` points that cover each range of points from begins[k] to ends[k] - 1."""
    counts = -(-(ends - begins) // size)
    owner = np.repeat(np.arange(len(counts)), counts)
    firsts = begins[owner] + size * (np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts))
    return Blocks(owner, firsts, np.minimum(firsts + size, ends[owner]))


def log_densities_of(densities: Float64) -> Float32:
    """Return log(densities); ABSENT for densities of 0."""
    return np.where(densities > 0, np.log(np.maximum(densities, 1e-300)), ABSENT).astype(np.float32)


def _zeros_if_none(odds: Float32 | None, points: Float32) -> Float32:
    return np.zeros(len(points), np.float32) if odds is None else odds
