"""Gaussian mixtures with a uniform outlier component, one for each of many point sets, fitted at the same time.

Equations are numbered as in the paper: [1] the mixture, [2] the E-step, [3, 4] the M-step. The uniform component is
that of Eckart et al., "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016. scikit-learn's mixture has
neither that nor evidence for single points, and is slower (tests/benchmarks/test_refiners.py compares them).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures.gaussian import (
    ABSENT,
)
from framework.refinement.mixtures.mixture_kernels import BLOCK, claim, coefficients, fit_all

BATCH = 16 * BLOCK  # points that a thread takes at once


@dataclass(frozen=True)
class Mixtures:
    """N mixtures of K Gaussians and one uniform component each. An absent component has weight 0."""

    weights: Float64  # (N, K) pi_k
    means: Float64  # (N, K, 3) mu_k, m
    covariances: Float64  # (N, K, 3, 3) Sigma_k, m^2
    outlier_weights: Float64  # (N,) pi of the uniform component
    outlier_densities: Float64  # (N,) its density, 1 / m^3
    log_likelihoods: Float64  # (N,) mean log p(x) of the points at the last E-step, in nats
    iterations: Int64  # (N,) EM iterations made


def fit(
    points: Float32,
    starts: Int64,
    labels: Int32,
    components: int,
    *,
    max_iterations: int,
    tolerance: float,
    variance_floor: float,
    outlier_fraction: float,
    prior_log_odds: Float32 | None = None,
    own_components: int = 1,
) -> Mixtures:
    """Fits a mixture to each point set `points[starts[k]:starts[k + 1]]` by expectation maximization.

    `labels` (S,) in [0, `components`) are the start: the first M-step takes them for certain responsibilities, so that
    the masks themselves are the start and not k-means. EM ends after `max_iterations` or when the mean log-likelihood
    gains less than `tolerance`. Eigenvalues of covariances are kept above `variance_floor` (m^2). A uniform component
    over the set's bounding box starts with `outlier_fraction` of the points; 0 leaves it out.

    `prior_log_odds` (S,), where given, says how much likelier than the mixture alone knows each point is to come from
    one of the first `own_components`: their densities at point i are multiplied by exp(prior_log_odds[i]) in eq. [2].
    The log-likelihood then is that of the weighted densities, known up to a constant.
    """
    n = len(starts) - 1
    weights, means = np.zeros((n, components)), np.zeros((n, components, 3))
    covariances = np.zeros((n, components, 3, 3))
    outliers, log_likelihoods = np.zeros((n, 2)), np.zeros(n)
    iterations = np.zeros(n, np.int64)
    odds = np.zeros(len(points), np.float32) if prior_log_odds is None else prior_log_odds
    fit_all(
        points, starts, labels, odds, own_components, max_iterations, tolerance, variance_floor, outlier_fraction,
        weights, means, covariances, outliers, log_likelihoods, iterations,
    )  # fmt: skip
    return Mixtures(weights, means, covariances, outliers[:, 0], outliers[:, 1], log_likelihoods, iterations)


def likely_members(
    points: Float32,
    begins: Int64,
    ends: Int64,
    mixtures: Mixtures,
    *,
    own_components: int,
    min_posterior: float,
    prior_log_odds: Float32 | None = None,
) -> Bool:
    """(S,) which of `points[begins[k]:ends[k]]` the first `own_components` of mixture k together claim: posterior above
    the bound.

    A mixture that lost all of its components claims every point: nothing is known against them. Points outside of the
    ranges are claimed by none.
    """
    rows = coefficients(mixtures.weights, mixtures.means, mixtures.covariances)
    log_outliers = _logarithms(mixtures.outlier_weights * mixtures.outlier_densities)
    odds = np.zeros(len(points), np.float32) if prior_log_odds is None else prior_log_odds
    blocks = -(-(ends - begins) // BATCH)
    owner = np.repeat(np.arange(len(begins)), blocks)
    firsts = begins[owner] + BATCH * (np.arange(len(owner)) - np.repeat(np.cumsum(blocks) - blocks, blocks))
    lasts = np.minimum(firsts + BATCH, ends[owner])
    claimed = np.zeros(len(points), np.bool_)
    claim(points, owner, firsts, lasts, odds, rows, log_outliers, own_components, min_posterior, claimed)
    return claimed


def _logarithms(values: Float64) -> Float32:
    """log(values), ABSENT for 0."""
    return np.where(values > 0, np.log(np.maximum(values, 1e-300)), ABSENT).astype(np.float32)
