"""Gaussian mixtures with a uniform outlier component, one for each of many point sets, fitted at the same time.

Equations are numbered as in the paper: [1] the mixture, [2] the E-step, [3, 4] the M-step. The uniform component is
that of Eckart et al., "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Float32, Float64, Int32

Int64 = npt.NDArray[np.int64]

LOG_2PI = float(np.log(2 * np.pi))
MIN_SUPPORT = 4.0  # points that a component needs to have a covariance of its own in 3D; with fewer it is dropped
JACOBI_SWEEPS = 6  # of a 3x3 matrix: converges quadratically, 4 suffice for double precision
BLOCK = 256  # points that a kernel handles at once: their densities stay in the first-level cache
ABSENT = np.float32(-1e30)  # log density of a component with weight 0; finite, so that differences are
SIMD = {"reassoc", "contract", "nsz", "arcp"}  # fast-math flags that allow vector code and leave infinities alone


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
    _fit_all(
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
    rows = _coefficients(mixtures.weights, mixtures.means, mixtures.covariances)
    log_outliers = _logarithms(mixtures.outlier_weights * mixtures.outlier_densities)
    odds = np.zeros(len(points), np.float32) if prior_log_odds is None else prior_log_odds
    blocks = -(-(ends - begins) // BLOCK)
    owner = np.repeat(np.arange(len(begins)), blocks)
    firsts = begins[owner] + BLOCK * (np.arange(len(owner)) - np.repeat(np.cumsum(blocks) - blocks, blocks))
    claimed = _claim(points, owner, firsts, ends, odds, rows, log_outliers, own_components, min_posterior)
    return np.asarray(claimed, np.bool_)


def _logarithms(values: Float64) -> Float32:
    """log(values), ABSENT for 0."""
    return np.where(values > 0, np.log(np.maximum(values, 1e-300)), ABSENT).astype(np.float32)


@njit(cache=True, nogil=True, parallel=True)
def _fit_all(
    points: Float32, starts: Int64, labels: Int32, odds: Float32, own_components: int, max_iterations: int,
    tolerance: float, variance_floor: float, outlier_fraction: float, weights: Float64, means: Float64,
    covariances: Float64, outliers: Float64, log_likelihoods: Float64, iterations: Int64,
) -> None:  # fmt: skip
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            _fit_one(
                points[starts[k] : starts[k + 1]], labels[starts[k] : starts[k + 1]], odds[starts[k] : starts[k + 1]],
                own_components, max_iterations, tolerance, variance_floor, outlier_fraction,
                weights[k], means[k], covariances[k], outliers[k], log_likelihoods[k : k + 1], iterations[k : k + 1],
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _fit_one(
    points: Float32, labels: Int32, odds: Float32, own_components: int, max_iterations: int, tolerance: float,
    variance_floor: float, outlier_fraction: float, weights: Float64, means: Float64, covariances: Float64,
    outlier: Float64, log_likelihood: Float64, iterations: Int64,
) -> None:  # fmt: skip
    count, components = len(points), len(weights)
    center, volume = _center_and_volume(points, variance_floor)
    outlier[0], outlier[1] = outlier_fraction, 1.0 / volume
    moments = np.zeros((components, 10))
    for i in range(count):
        _add(moments[labels[i]], points[i], center, 1.0 - outlier_fraction)
    _maximize(moments, center, count, variance_floor, weights, means, covariances)
    xyz = np.empty((3, count), np.float32)  # centered, so that single precision suffices
    for i in range(count):
        for a in range(3):
            xyz[a, i] = points[i, a] - center[a]
    rows = np.zeros((components, 10), np.float32)
    previous = -np.inf
    for iteration in range(max_iterations):
        if weights.sum() == 0.0:
            return
        for j in range(components):
            _set_coefficients(weights[j], means[j], covariances[j], rows[j])
            for a in range(3):
                rows[j, 1 + a] = means[j, a] - center[a]
        log_outlier = np.float32(math.log(outlier[0] * outlier[1])) if outlier[0] > 0 else ABSENT
        moments[:] = 0.0
        total, outliers = _expect(xyz, odds, own_components, rows, log_outlier, moments)
        _maximize(moments, center, count, variance_floor, weights, means, covariances)
        outlier[0] = outliers / count
        iterations[0], log_likelihood[0] = iteration + 1, total / count
        if log_likelihood[0] - previous < tolerance:
            break
        previous = log_likelihood[0]


@njit(cache=True, nogil=True)
def _expect(
    xyz: Float32, odds: Float32, own_components: int, rows: Float32, log_outlier: np.float32, moments: Float64
) -> tuple[float, float]:
    """E-step [2], which at once sums the M-step's moments; returns sum_i log p(x_i) and the outliers' N_k."""
    components = len(rows)
    densities = np.empty((components, BLOCK), np.float32)
    largest, evidence = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    total, outliers = 0.0, 0.0
    for first in range(0, xyz.shape[1], BLOCK):
        x, y, z = xyz[0, first : first + BLOCK], xyz[1, first : first + BLOCK], xyz[2, first : first + BLOCK]
        n = len(x)
        largest[:n] = log_outlier
        for j in range(components):
            _log_densities(x, y, z, rows[j], densities[j])
            if j < own_components:
                _add_to(densities[j], odds[first : first + n])
            _raise_to(largest, densities[j], n)
        _constant_exponential(log_outlier, largest, evidence, n)
        outliers_before = evidence[:n].copy()
        for j in range(components):
            _exponentials(densities[j], largest, evidence, n)
        for i in range(n):
            total += largest[i] + math.log(evidence[i])
            evidence[i] = np.float32(1.0) / evidence[i]
            outliers += outliers_before[i] * evidence[i]
        for j in range(components):
            _add_moments(x, y, z, densities[j], evidence, moments[j])
    return total, outliers


@njit(cache=True, nogil=True, fastmath=SIMD)
def _log_densities(x: Float32, y: Float32, z: Float32, row: Float32, out: Float32) -> None:
    """out[i] = log(pi_k N(x_i | mu_k, Sigma_k))."""
    c, mx, my, mz, w00, w10, w11, w20, w21, w22 = row
    half = np.float32(-0.5)
    for i in range(len(x)):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        a, b, d = w00 * dx, w10 * dx + w11 * dy, w20 * dx + w21 * dy + w22 * dz
        out[i] = c + half * (a * a + b * b + d * d)


@njit(cache=True, nogil=True, fastmath=SIMD)
def _add_to(values: Float32, summands: Float32) -> None:
    for i in range(len(summands)):
        values[i] += summands[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _raise_to(values: Float32, others: Float32, n: int) -> None:
    """values = max(values, others), of the first n; a comparison vectorizes where max() does not."""
    for i in range(n):
        values[i] = others[i] if others[i] > values[i] else values[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _exp(t: np.float32) -> np.float32:
    """exp(t) for t <= 0 with a relative error of 3e-7, in steps that vectorize: 2^k * 2^r with |r| <= 1/2.

    Below exp(-50) = 2e-22 it stays there: products with denormal numbers are a hundred times slower.
    """
    t = max(t, np.float32(-50.0)) * np.float32(1.4426950408889634)
    k = math.floor(t + np.float32(0.5))
    r = t - np.float32(k)
    p = np.float32(1.3398874e-3)
    p = p * r + np.float32(9.6184373e-3)
    p = p * r + np.float32(5.5503324e-2)
    p = p * r + np.float32(2.4022648e-1)
    p = p * r + np.float32(6.9314720e-1)
    p = p * r + np.float32(1.0)
    return p * np.int32((np.int32(k) + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(cache=True, nogil=True, fastmath=SIMD)
def _constant_exponential(log_density: np.float32, largest: Float32, evidence: Float32, n: int) -> None:
    for i in range(n):
        evidence[i] = _exp(log_density - largest[i])


@njit(cache=True, nogil=True, fastmath=SIMD)
def _exponentials(densities: Float32, largest: Float32, evidence: Float32, n: int) -> None:
    """densities = exp(densities - largest), added to the evidence; of the first n."""
    for i in range(n):
        densities[i] = _exp(densities[i] - largest[i])
        evidence[i] += densities[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _add_moments(x: Float32, y: Float32, z: Float32, densities: Float32, scale: Float32, moment: Float64) -> None:
    """Adds sum_i gamma_i (1, x_i, x_i x_i^T); single precision suffices within a block."""
    zero = np.float32(0.0)
    s, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(len(x)):
        gamma = densities[i] * scale[i]
        gx, gy, gz = gamma * x[i], gamma * y[i], gamma * z[i]
        s += gamma
        sx += gx
        sy += gy
        sz += gz
        sxx += gx * x[i]
        sxy += gx * y[i]
        sxz += gx * z[i]
        syy += gy * y[i]
        syz += gy * z[i]
        szz += gz * z[i]
    for a, value in enumerate((s, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz)):
        moment[a] += value


@njit(cache=True, nogil=True)
def _add(moment: Float64, point: Float32, center: Float64, gamma: float) -> None:
    """Adds gamma * (1, x, x x^T) of the centered point; of the symmetric matrix the upper triangle."""
    x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    gx, gy, gz = gamma * x, gamma * y, gamma * z
    moment[0] += gamma
    moment[1] += gx
    moment[2] += gy
    moment[3] += gz
    moment[4] += gx * x
    moment[5] += gx * y
    moment[6] += gx * z
    moment[7] += gy * y
    moment[8] += gy * z
    moment[9] += gz * z


@njit(cache=True, nogil=True)
def _maximize(
    moments: Float64, center: Float64, count: int, variance_floor: float, weights: Float64, means: Float64,
    covariances: Float64,
) -> None:  # fmt: skip
    """M-step [3, 4]."""
    for j in range(len(weights)):
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
        _floor_eigenvalues(Sigma, variance_floor)


@njit(cache=True, nogil=True)
def _floor_eigenvalues(Sigma: Float64, floor: float) -> None:
    """Raises the eigenvalues of a symmetric (3, 3) matrix to at least `floor`, in place (cyclic Jacobi)."""
    A, V = Sigma.copy(), np.eye(3)
    for _ in range(JACOBI_SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                t = t if theta >= 0 else -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for r in range(3):
                    A[r, p], A[r, q] = c * A[r, p] - s * A[r, q], s * A[r, p] + c * A[r, q]
                for r in range(3):
                    A[p, r], A[q, r] = c * A[p, r] - s * A[q, r], s * A[p, r] + c * A[q, r]
                for r in range(3):
                    V[r, p], V[r, q] = c * V[r, p] - s * V[r, q], s * V[r, p] + c * V[r, q]
    if min(A[0, 0], A[1, 1], A[2, 2]) >= floor:
        return
    for r in range(3):
        for c in range(3):
            Sigma[r, c] = 0.0
            for k in range(3):
                Sigma[r, c] += V[r, k] * max(A[k, k], floor) * V[c, k]


@njit(cache=True, nogil=True)
def _set_coefficients(weight: float, mean: Float64, Sigma: Float64, row: Float32) -> None:
    """row = log(pi_k / sqrt((2 pi)^3 |Sigma|)), mu_k, and L^-1 of Sigma = L L^T, row by row.

    Whitening by L^-1 keeps single precision accurate where the entries of Sigma^-1 would cancel.
    """
    if weight <= 0.0:
        row[:] = 0.0
        row[0] = ABSENT
        return
    l00 = math.sqrt(Sigma[0, 0])
    l10, l20 = Sigma[1, 0] / l00, Sigma[2, 0] / l00
    l11 = math.sqrt(Sigma[1, 1] - l10 * l10)
    l21 = (Sigma[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(Sigma[2, 2] - l20 * l20 - l21 * l21)
    row[0] = math.log(weight) - 1.5 * LOG_2PI - math.log(l00 * l11 * l22)
    row[1], row[2], row[3] = mean[0], mean[1], mean[2]
    row[4] = 1.0 / l00
    row[5], row[6] = -l10 / (l00 * l11), 1.0 / l11
    row[7] = (l10 * l21 / l11 - l20) / (l00 * l22)
    row[8], row[9] = -l21 / (l11 * l22), 1.0 / l22


@njit(cache=True, nogil=True)
def _center_and_volume(points: Float32, variance_floor: float) -> tuple[Float64, float]:
    """The mean of the points, and the volume of their bounding box with no side below four standard deviations."""
    center = np.zeros(3)
    low, high = points[0].astype(np.float64), points[0].astype(np.float64)
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
def _coefficients(weights: Float64, means: Float64, covariances: Float64) -> Float32:
    rows = np.zeros((*weights.shape, 10), np.float32)
    for k in range(weights.shape[0]):
        for j in range(weights.shape[1]):
            _set_coefficients(weights[k, j], means[k, j], covariances[k, j], rows[k, j])
    return rows


@njit(cache=True, nogil=True, parallel=True)
def _claim(
    points: Float32, owner: Int64, firsts: Int64, ends: Int64, odds: Float32, rows: Float32, log_outliers: Float32,
    own_components: int, min_posterior: float,
) -> Bool:  # fmt: skip
    """Whether own / (own + others) > min_posterior for each point of the blocks that begin at `firsts`."""
    claimed = np.zeros(len(points), np.bool_)
    for b in prange(len(owner)):
        k, first = owner[b], firsts[b]
        _claim_block(
            points[first : min(first + BLOCK, ends[k])], odds[first : first + BLOCK], rows[k], log_outliers[k],
            own_components, min_posterior, claimed[first : first + BLOCK],
        )  # fmt: skip
    return claimed


@njit(cache=True, nogil=True)
def _claim_block(
    points: Float32, odds: Float32, rows: Float32, log_outlier: np.float32, own_components: int, min_posterior: float,
    claimed: Bool,
) -> None:  # fmt: skip
    n, components = len(points), len(rows)
    if rows[:, 0].max() <= ABSENT:
        claimed[:n] = True
        return
    xyz, densities = np.empty((3, n), np.float32), np.empty((components, n), np.float32)
    for i in range(n):
        for a in range(3):
            xyz[a, i] = points[i, a]
    largest, own, others = np.full(n, log_outlier), np.zeros(n, np.float32), np.empty(n, np.float32)
    for j in range(components):
        _log_densities(xyz[0], xyz[1], xyz[2], rows[j], densities[j])
        if j < own_components:
            _add_to(densities[j], odds[:n])
        _raise_to(largest, densities[j], n)
    _constant_exponential(log_outlier, largest, others, n)
    for j in range(own_components):
        _exponentials(densities[j], largest, own, n)
    for j in range(own_components, components):
        _exponentials(densities[j], largest, others, n)
    for i in range(n):
        claimed[i] = own[i] > min_posterior * (own[i] + others[i])
