"""Vectorized Gaussian densities and moments for expectation maximization.

The exponential is custom, because Numba does not vectorize the exponential of NumPy without Intel SVML. The eigenvalues
are custom, because Numba calls LAPACK for each 3x3 matrix.
"""

from __future__ import annotations

import math

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64

LOG_2PI = float(np.log(2 * np.pi))
JACOBI_SWEEPS = 6  # maximum number of sweeps; 4 suffice for a 3x3 matrix in double precision
NEGLIGIBLE = 1e-28  # sum of squared off-diagonal elements, relative to the squared trace, at which Jacobi stops
ABSENT = np.float32(-1e30)  # log density of a component with weight 0; finite, so that differences are finite
FACTORS = 64  # number of factors per logarithm; with up to 10^4 components, the product stays below 1e256
SIMD = {"reassoc", "contract", "nsz", "arcp"}  # fast-math flags for vectorization; infinities remain valid


@njit(cache=True, nogil=True, fastmath=SIMD)
def log_densities(x: Float32, y: Float32, z: Float32, row: Float32, out: Float32) -> None:
    """Compute the weighted log density of one Gaussian at each point.

    Args:
        x: The first coordinate (n,) of the points, m.
        y: The second coordinate (n,) of the points, m.
        z: The third coordinate (n,) of the points, m.
        row: The coefficients (10,) of the Gaussian, from set_coefficients().
        out: The output (n,).
    """
    c, mx, my, mz = row[0], row[1], row[2], row[3]  # unpacking the array takes longer than the loop
    w00, w10, w11, w20, w21, w22 = row[4], row[5], row[6], row[7], row[8], row[9]
    half = np.float32(-0.5)
    for i in range(len(x)):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        a, b, d = w00 * dx, w10 * dx + w11 * dy, w20 * dx + w21 * dy + w22 * dz
        out[i] = c + half * (a * a + b * b + d * d)


@njit(cache=True, nogil=True, fastmath=SIMD)
def raise_to_density(x: Float32, y: Float32, z: Float32, row: Float32, values: Float32) -> None:
    """Raise each value to at least the weighted log density of one Gaussian at its point."""
    c, mx, my, mz = row[0], row[1], row[2], row[3]
    w00, w10, w11, w20, w21, w22 = row[4], row[5], row[6], row[7], row[8], row[9]
    half = np.float32(-0.5)
    for i in range(len(x)):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        a, b, d = w00 * dx, w10 * dx + w11 * dy, w20 * dx + w21 * dy + w22 * dz
        density = c + half * (a * a + b * b + d * d)
        values[i] = density if density > values[i] else values[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def add_to(values: Float32, summands: Float32) -> None:
    """Add `summands` to `values` in place."""
    for i in range(len(summands)):
        values[i] += summands[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def raise_to(values: Float32, others: Float32, n: int) -> None:
    """Set the first `n` values to max(values, others)."""
    for i in range(n):  # a comparison, because max() would not be vectorized
        values[i] = others[i] if others[i] > values[i] else values[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _exp(t: np.float32) -> np.float32:
    """Return exp(t) for t <= 0 with a relative error of 3e-7, and at least exp(-50)."""
    # 2^k * 2^r with |r| <= 1/2, in vectorizable code; denormal numbers would be slow
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
def constant_exponential(log_density: np.float32, largest: Float32, evidence: Float32, n: int) -> None:
    """Set the first `n` values of `evidence` to exp(log_density - largest)."""
    for i in range(n):
        evidence[i] = _exp(log_density - largest[i])


@njit(cache=True, nogil=True, fastmath=SIMD)
def exponentials(densities: Float32, largest: Float32, evidence: Float32, n: int) -> None:
    """Replace the first `n` log densities with exp(densities - largest), and add them to `evidence`."""
    for i in range(n):
        densities[i] = _exp(densities[i] - largest[i])
        evidence[i] += densities[i]


@njit(cache=True, nogil=True)
def log_evidence(largest: Float32, evidence: Float32, n: int) -> float:
    """Return the sum of largest + log(evidence) over the first `n` points."""
    total = 0.0
    for begin in range(0, n, FACTORS):  # one logarithm of a product; factors are in [1, 1 + number of components]
        end = min(begin + FACTORS, n)
        total += _sum(largest[begin:end]) + math.log(_product(evidence[begin:end]))
    return total


@njit(cache=True, nogil=True, fastmath=SIMD)
def _sum(values: Float32) -> float:
    total = 0.0
    for value in values:
        total += value
    return total


@njit(cache=True, nogil=True, fastmath=SIMD)
def _product(values: Float32) -> float:
    product = 1.0
    for value in values:
        product *= value
    return product


@njit(cache=True, nogil=True, fastmath=SIMD)
def invert(values: Float32, others: Float32, n: int) -> float:
    """Replace the first `n` values with 1 / values, and return the sum of others / values."""
    total = np.float32(0.0)
    for i in range(n):
        values[i] = np.float32(1.0) / values[i]
        total += others[i] * values[i]
    return float(total)


@njit(cache=True, nogil=True, fastmath=SIMD)
def add_moments(x: Float32, y: Float32, z: Float32, densities: Float32, scale: Float32, moment: Float64) -> None:
    """Add the moments of the points, weighted by densities * scale, to `moment` (10,).

    The moments are the weight, the weighted coordinates (3) and the upper triangle of their outer product (6). Single
    precision suffices within a block.
    """
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
def add_point(moment: Float64, point: Float32, center: Float64, gamma: float) -> None:
    """Add the moments of `point` relative to `center`, weighted by `gamma`, to `moment` (10,)."""
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
def floor_eigenvalues(Sigma: Float64, floor: float) -> None:
    """Raise the eigenvalues of a symmetric 3x3 matrix to at least `floor`, in place."""
    A, V = Sigma.copy(), np.eye(3)  # cyclic Jacobi method
    for _ in range(JACOBI_SWEEPS):
        if A[0, 1] * A[0, 1] + A[0, 2] * A[0, 2] + A[1, 2] * A[1, 2] < NEGLIGIBLE * (A[0, 0] + A[1, 1] + A[2, 2]) ** 2:
            break
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
def set_coefficients(weight: float, mean: Float64, Sigma: Float64, row: Float32) -> None:
    """Set the coefficients (10,) of a Gaussian for log_densities()."""
    # The coefficients are log(pi / sqrt((2 pi)^3 |Sigma|)), mu and the rows of L^-1, where Sigma = L L^T. In single
    # precision, whitening by L^-1 is accurate even where terms with Sigma^-1 would cancel.
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
