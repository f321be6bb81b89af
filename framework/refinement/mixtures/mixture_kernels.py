"""Kernels of mixture.py."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.refinement.mixtures.gaussian import (
    ABSENT,
    add_moments,
    add_point,
    add_to,
    constant_exponential,
    exponentials,
    floor_eigenvalues,
    invert,
    log_densities,
    log_evidence,
    raise_to,
    raise_to_density,
    set_coefficients,
)

MIN_SUPPORT = 4.0  # minimum number of points of a component; with fewer, it has no 3D covariance and is dropped
BLOCK = 256  # number of points that a kernel processes at once; their densities fit into the L1 cache
MARGIN = 1e-3  # bound on the rounding error of log densities in single precision, nats


class EmSettings(NamedTuple):
    """Settings of expectation maximization."""

    max_iterations: int  # maximum number of iterations
    tolerance: float  # minimum increase of the mean log-likelihood to continue EM, nats per point
    variance_floor: float  # minimum eigenvalue of a covariance, m^2
    outlier_fraction: float  # initial fraction of outlier points; 0 = no uniform component


class Mixtures(NamedTuple):
    """N mixtures of K Gaussians and one uniform component each.

    A component with weight 0 is absent.
    """

    weights: Float64  # (N, K) pi_k
    means: Float64  # (N, K, 3) mu_k, m
    covariances: Float64  # (N, K, 3, 3) Sigma_k, m^2
    outlier_weights: Float64  # (N,) pi of the uniform component
    outlier_densities: Float64  # (N,) density of the uniform component, 1 / m^3
    log_likelihoods: Float64  # (N,) mean log p(x) of the points at the last E-step, in nats
    iterations: Int64  # (N,) number of EM iterations


class Blocks(NamedTuple):
    """B blocks of consecutive points of the same set."""

    sets: Int64  # (B,) index of the set
    begins: Int64  # (B,) index of the first point
    ends: Int64  # (B,) index after the last point


@njit(cache=True, nogil=True, parallel=True)
def fit_all(
    points: Float32, starts: Int64, labels: Int32, odds: Float32, own_components: int, settings: EmSettings,
    mixtures: Mixtures,
) -> None:  # fmt: skip
    """Fit a mixture to each set of points.

    The result is written to `mixtures`. See mixture.fit().
    """
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            own = slice(starts[k], starts[k + 1])
            _fit_one(points[own], labels[own], odds[own], own_components, settings, mixtures, k)


@njit(cache=True, nogil=True, parallel=True)
def improve_all(points: Float32, starts: Int64, odds: Float32, settings: EmSettings, mixtures: Mixtures) -> None:
    """Run expectation maximization on each set of points, starting from the current mixtures."""
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            own = slice(starts[k], starts[k + 1])
            center, volume = _center_and_volume(points[own], settings.variance_floor)
            mixtures.outlier_weights[k], mixtures.outlier_densities[k] = settings.outlier_fraction, 1.0 / volume
            _iterate(points[own], odds[own], 0, center, settings, mixtures, k)  # odds are unused for 0 own components


@njit(cache=True, nogil=True)
def _fit_one(
    points: Float32, labels: Int32, odds: Float32, own_components: int, settings: EmSettings, mixtures: Mixtures, k: int
) -> None:
    weights, means, covariances = mixtures.weights[k], mixtures.means[k], mixtures.covariances[k]
    center, volume = _center_and_volume(points, settings.variance_floor)
    mixtures.outlier_weights[k], mixtures.outlier_densities[k] = settings.outlier_fraction, 1.0 / volume
    moments = np.zeros((len(weights), 10))
    for i in range(len(points)):
        add_point(moments[labels[i]], points[i], center, 1.0 - settings.outlier_fraction)
    _maximize(moments, center, len(points), settings.variance_floor, weights, means, covariances)
    _iterate(points, odds, own_components, center, settings, mixtures, k)


@njit(cache=True, nogil=True)
def _iterate(
    points: Float32, odds: Float32, own_components: int, center: Float64, settings: EmSettings, mixtures: Mixtures,
    k: int,
) -> None:  # fmt: skip
    """Run expectation maximization on mixture k, starting from its current components."""
    weights, means, covariances = mixtures.weights[k], mixtures.means[k], mixtures.covariances[k]
    outlier_weights, log_likelihoods = mixtures.outlier_weights, mixtures.log_likelihoods
    variance_floor, count, components = settings.variance_floor, len(points), len(weights)
    moments = np.zeros((components, 10))
    xyz = np.empty((3, count), np.float32)  # centered, so that single precision suffices
    for i in range(count):
        for a in range(3):
            xyz[a, i] = points[i, a] - center[a]
    rows = np.zeros((components, 10), np.float32)
    previous = -np.inf
    for iteration in range(settings.max_iterations):
        if not _any_left(weights):
            return
        for j in range(components):
            set_coefficients(weights[j], means[j], covariances[j], rows[j])
            for a in range(3):
                rows[j, 1 + a] = means[j, a] - center[a]
        outlier_evidence = outlier_weights[k] * mixtures.outlier_densities[k]
        log_outlier = np.float32(math.log(outlier_evidence)) if outlier_weights[k] > 0 else ABSENT
        moments[:] = 0.0
        total, outliers = _expect(xyz, odds, own_components, rows, log_outlier, moments)
        _maximize(moments, center, count, variance_floor, weights, means, covariances)
        outlier_weights[k] = outliers / count
        mixtures.iterations[k], log_likelihoods[k] = iteration + 1, total / count
        if log_likelihoods[k] - previous < settings.tolerance:
            break
        previous = log_likelihoods[k]


@njit(cache=True, nogil=True)
def _any_left(weights: Float64) -> bool:
    left = False
    for weight in weights:
        left = left or weight != 0.0
    return left


@njit(cache=True, nogil=True)
def _expect(
    xyz: Float32, odds: Float32, own_components: int, rows: Float32, log_outlier: np.float32, moments: Float64
) -> tuple[float, float]:
    """Run the E-step on centered points (3, S), and add to the moments (K, 10) for the M-step.

    Returns the log-likelihood and the sum of the responsibilities of the uniform component.
    """
    components = len(rows)  # eq. (2) of docs/method.md
    densities = np.empty((components, BLOCK), np.float32)
    largest, evidence = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    outliers_before = np.empty(BLOCK, np.float32)
    total, outliers = 0.0, 0.0
    for first in range(0, xyz.shape[1], BLOCK):
        x, y, z = xyz[0, first : first + BLOCK], xyz[1, first : first + BLOCK], xyz[2, first : first + BLOCK]
        n = len(x)
        largest[:n] = log_outlier
        for j in range(components):
            log_densities(x, y, z, rows[j], densities[j])
            if j < own_components:
                add_to(densities[j], odds[first : first + n])
            raise_to(largest, densities[j], n)
        constant_exponential(log_outlier, largest, evidence, n)
        for i in range(n):
            outliers_before[i] = evidence[i]
        for j in range(components):
            exponentials(densities[j], largest, evidence, n)
        total += log_evidence(largest, evidence, n)
        outliers += invert(evidence, outliers_before, n)
        for j in range(components):
            add_moments(x, y, z, densities[j], evidence, moments[j])
    return total, outliers


@njit(cache=True, nogil=True)
def _maximize(
    moments: Float64, center: Float64, count: int, variance_floor: float, weights: Float64, means: Float64,
    covariances: Float64,
) -> None:  # fmt: skip
    """Run the M-step: compute the weights, means and covariances of the components from their moments (K, 10).

    A component with too few points gets weight 0.
    """
    for j in range(len(weights)):  # eqs. (3) and (4) of docs/method.md
        N_k = moments[j, 0]
        if N_k < MIN_SUPPORT:
            weights[j] = 0.0
            continue
        weights[j] = N_k / count
        x, y, z = moments[j, 1] / N_k, moments[j, 2] / N_k, moments[j, 3] / N_k
        means[j, 0], means[j, 1], means[j, 2] = center[0] + x, center[1] + y, center[2] + z
        Sigma = covariances[j]
        Sigma[0, 0] = moments[j, 4] / N_k - x * x
        Sigma[0, 1] = Sigma[1, 0] = moments[j, 5] / N_k - x * y
        Sigma[0, 2] = Sigma[2, 0] = moments[j, 6] / N_k - x * z
        Sigma[1, 1] = moments[j, 7] / N_k - y * y
        Sigma[1, 2] = Sigma[2, 1] = moments[j, 8] / N_k - y * z
        Sigma[2, 2] = moments[j, 9] / N_k - z * z
        floor_eigenvalues(Sigma, variance_floor)


@njit(cache=True, nogil=True)
def _center_and_volume(points: Float32, variance_floor: float) -> tuple[Float64, float]:
    """Return the mean of the points (3,), m, and the volume of their bounding box, m^3.

    The box has a minimum side that depends on `variance_floor`, m^2.
    """
    center, low, high = np.zeros(3), np.empty(3), np.empty(3)
    for a in range(3):
        low[a] = high[a] = points[0, a]
    for i in range(len(points)):
        for a in range(3):
            center[a] += points[i, a]
            low[a] = min(low[a], points[i, a])
            high[a] = max(high[a], points[i, a])
    volume = 1.0
    for a in range(3):
        center[a] /= len(points)
        volume *= max(high[a] - low[a], 4.0 * math.sqrt(variance_floor))
    return center, volume


@njit(cache=True, nogil=True)
def coefficients(weights: Float64, means: Float64, covariances: Float64) -> Float32:
    """Return the coefficients (M, 10) of Gaussians for log_densities()."""
    rows = np.zeros((len(weights), 10), np.float32)
    for j in range(len(weights)):
        set_coefficients(weights[j], means[j], covariances[j], rows[j])
    return rows


@njit(cache=True, nogil=True, parallel=True)
def claim(
    points: Float32, blocks: Blocks, odds: Float32, rows: Float32, log_outliers: Float32, own_components: int,
    min_posterior: float, claimed: Bool,
) -> None:  # fmt: skip
    """Find the points that belong to the object.

    See likely_members().

    Args:
        points: The points (S, 3), m.
        blocks: The blocks of points to process.
        odds: The log-odds (S,) of each point for the object.
        rows: The coefficients (N, K, 10) of the mixtures, from coefficients().
        log_outliers: The weighted log density (N,) of the uniform components.
        own_components: The number of components of the object.
        min_posterior: The minimum posterior probability.
        claimed: The output (S,).
    """
    for b in prange(len(blocks.sets)):
        k, begin, end = blocks.sets[b], blocks.begins[b], blocks.ends[b]
        absent = True
        for component in range(rows.shape[1]):
            absent = absent and rows[k, component, 0] <= ABSENT
        if absent:
            claimed[begin:end] = True
        else:
            _claim_batch(
                points[begin:end], odds[begin:end], rows[k], log_outliers[k], own_components, min_posterior,
                claimed[begin:end],
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _claim_batch(
    points: Float32, odds: Float32, rows: Float32, log_outlier: np.float32, own_components: int, min_posterior: float,
    claimed: Bool,
) -> None:  # fmt: skip
    """Find the points of one mixture that belong to the object."""
    # Most points need no exponentials, because a sum of n terms is between its largest term and n times this term.
    components = len(rows)
    log_bound = math.log(min_posterior / (1.0 - min_posterior))
    certain = np.float32(log_bound + math.log(components - own_components + 1.0) + MARGIN)
    hopeless = np.float32(log_bound - math.log(own_components) - MARGIN)
    xyz, densities = np.empty((3, BLOCK), np.float32), np.empty((components, BLOCK), np.float32)
    own, others = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    doubtful, doubts = np.empty(len(points) + 1, np.int64), 0
    for first in range(0, len(points), BLOCK):
        n = min(BLOCK, len(points) - first)
        for i in range(n):
            for a in range(3):
                xyz[a, i] = points[first + i, a]
        own[:n], others[:n] = ABSENT, log_outlier
        for j in range(components):
            raise_to_density(xyz[0, :n], xyz[1, :n], xyz[2, :n], rows[j], own if j < own_components else others)
        for i in range(n):
            margin = own[i] + odds[first + i] - others[i]
            claimed[first + i] = margin > certain
            doubtful[doubts] = first + i
            doubts += hopeless < margin <= certain
    own_odds, largest = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    for first in range(0, doubts, BLOCK):
        n = min(BLOCK, doubts - first)
        for d in range(n):
            i = doubtful[first + d]
            own_odds[d] = odds[i]
            for a in range(3):
                xyz[a, d] = points[i, a]
        largest[:n], own[:n] = log_outlier, 0
        for j in range(components):
            log_densities(xyz[0, :n], xyz[1, :n], xyz[2, :n], rows[j], densities[j])
            if j < own_components:
                add_to(densities[j], own_odds[:n])
            raise_to(largest, densities[j], n)
        constant_exponential(log_outlier, largest, others, n)
        for j in range(components):
            exponentials(densities[j], largest, own if j < own_components else others, n)
        for d in range(n):
            claimed[doubtful[first + d]] = own[d] > min_posterior * (own[d] + others[d])
