"""Kernels of mixture_tree.py."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures.gaussian import SIMD, constant_exponential, exponentials, log_densities
from framework.refinement.mixtures.mixture_kernels import MIN_SUPPORT, Blocks

RATIO_ITERATIONS = 20  # number of EM iterations for an object fraction; with clear evidence, each halves the error


@njit(cache=True, nogil=True, parallel=True)
def cut_all(points: Float32, starts: Int64, groups: int, labels: Int32) -> None:
    """Divide each set of points into groups, and set their labels (S,).

    See cut().
    """
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            _cut_one(points[starts[k] : starts[k + 1]], groups, labels[starts[k] : starts[k + 1]])


@njit(cache=True, nogil=True)
def _cut_one(points: Float32, groups: int, labels: Int32) -> None:
    # the points of a group are contiguous in `order`, so that a cut reads only its own group
    n = len(points)
    order, upper = np.arange(n), np.empty(n, np.int64)
    begins, ends = np.zeros(groups, np.int64), np.zeros(groups, np.int64)
    means, scatters = np.zeros((groups, 3)), np.zeros((groups, 3))
    ends[0] = n
    _measure(points, order, means[0], scatters[0])
    used = 1
    while used < groups:
        g, axis, largest = 0, 0, 0.0
        for j in range(used):
            for a in range(3):
                if scatters[j, a] > largest:
                    g, axis, largest = j, a, scatters[j, a]
        if largest == 0.0:
            return
        low, high = begins[g], 0
        for r in range(begins[g], ends[g]):
            i = order[r]
            if points[i, axis] > means[g, axis]:
                upper[high] = i
                high += 1
            else:
                order[low] = i
                low += 1
        order[low : ends[g]] = upper[:high]
        if high < MIN_SUPPORT or low - begins[g] < MIN_SUPPORT:
            scatters[g] = 0.0
            continue
        begins[used], ends[used], ends[g] = low, ends[g], low
        for j in (g, used):
            _measure(points, order[begins[j] : ends[j]], means[j], scatters[j])
        for i in order[begins[used] : ends[used]]:
            labels[i] = used
        used += 1


@njit(cache=True, nogil=True)
def _measure(points: Float32, members: Int64, mean: Float64, scatter: Float64) -> None:
    """Set the mean (3,), m, and the sum of squared deviations (3,), m^2, of the given points along each axis."""
    origin = points[members[0]]  # offsets from a member avoid cancellation in the variance
    count, sums, squares = len(members), np.zeros(3), np.zeros(3)
    for i in members:
        for a in range(3):
            x = float(points[i, a] - origin[a])
            sums[a] += x
            squares[a] += x * x
    for a in range(3):
        mean[a] = origin[a] + sums[a] / count
        scatter[a] = max(squares[a] - sums[a] * sums[a] / count, 0.0)


@njit(cache=True, nogil=True)
def bounding_boxes(points: Float32, starts: Int64, least_side: float) -> Float64:
    """Return the bounding box (N, 2, 3), m, of each set of points.

    The sides are at least `least_side`, m.
    """
    boxes = np.zeros((len(starts) - 1, 2, 3))
    for k in range(len(starts) - 1):
        for a in range(3):
            low, high = np.inf, -np.inf
            for i in range(starts[k], starts[k + 1]):
                low, high = min(low, points[i, a]), max(high, points[i, a])
            margin = max(0.5 * (least_side - (high - low)), 0.0)
            boxes[k, 0, a], boxes[k, 1, a] = low - margin, high + margin
    return boxes


@njit(cache=True, nogil=True, parallel=True)
def pass_down(
    points: Float32, log_odds: Float32, blocks: Blocks, rows: Float32, ratios: Float32, firsts: Int64,
    log_outliers: Float32, outlier_ratios: Float32, child: Int64, posterior: Float32,
) -> None:  # fmt: skip
    """Find the best child and the posterior probability for the object of each point.

    See MixtureTree.best_nodes_with_posteriors(). The set of a block is the node of its points.
    """
    for b in prange(len(blocks.sets)):
        q, own = blocks.sets[b], slice(blocks.begins[b], blocks.ends[b])
        children = slice(firsts[q], firsts[q + 1])
        _pass_block(
            points[own], log_odds[own], rows[children], ratios[children], firsts[q], log_outliers[q],
            outlier_ratios[q], child[own], posterior[own],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _pass_block(
    points: Float32, log_odds: Float32, rows: Float32, ratios: Float32, first_child: int, log_outlier: np.float32,
    outlier_ratio: np.float32, child: Int64, posterior: Float32,
) -> None:  # fmt: skip
    n, children = len(points), len(rows)
    child[:] = -1
    posterior[:] = 0
    if children == 0:
        return
    xyz, densities = np.empty((3, n), np.float32), np.empty((children, n), np.float32)
    for i in range(n):
        for a in range(3):
            xyz[a, i] = points[i, a]
    largest, best = np.full(n, log_outlier), np.full(n, -1, np.int32)
    for j in range(children):
        log_densities(xyz[0], xyz[1], xyz[2], rows[j], densities[j])
        take_better(densities[j], np.int32(j), largest, best)
    for i in range(n):
        child[i] = first_child + best[i] if best[i] >= 0 else -1
    evidence = np.empty(n, np.float32)
    constant_exponential(log_outlier, largest, evidence, n)
    for i in range(n):
        posterior[i] = outlier_ratio * evidence[i]
    for j in range(children):
        exponentials(densities[j], largest, evidence, n)
        _add_scaled(densities[j], ratios[j], posterior)
    for i in range(n):
        own = posterior[i] * np.exp(log_odds[i])
        posterior[i] = own / (own + max(evidence[i] - posterior[i], np.float32(0)))


@njit(cache=True, nogil=True, fastmath=SIMD)
def take_better(densities: Float32, j: np.int32, largest: Float32, best: Int32) -> None:
    """Where `densities` exceeds `largest`, set `largest` to the density and `best` to `j`."""
    for i in range(len(largest)):
        better = densities[i] > largest[i]
        best[i] = j if better else best[i]
        largest[i] = densities[i] if better else largest[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _add_scaled(densities: Float32, scale: np.float32, values: Float32) -> None:
    for i in range(len(values)):
        values[i] += scale * densities[i]


@njit(cache=True, nogil=True, parallel=True)
def set_own_ratios(log_odds: Float32, starts: Int64, above_points: float, ratios: Float32) -> None:
    """Replace the object fractions (M,) of the parents with those of the nodes.

    See own_ratios().
    """
    for j in prange(len(starts) - 1):
        if starts[j + 1] > starts[j]:
            odds = np.exp(log_odds[starts[j] : starts[j + 1]])
            ratios[j] = _likeliest_ratio(odds, float(ratios[j]), above_points)


@njit(cache=True, nogil=True)
def _likeliest_ratio(odds: Float32, above: float, above_points: float) -> float:
    ratio = 0.5  # EM maximizes sum_i log(ratio * odds_i + 1 - ratio)
    for _ in range(RATIO_ITERATIONS):
        own = above_points * above
        for odd in odds:
            own += ratio * odd / (ratio * odd + 1.0 - ratio)
        ratio = own / (len(odds) + above_points)
    return ratio
