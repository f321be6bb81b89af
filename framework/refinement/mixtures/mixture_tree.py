"""Hierarchical Gaussian mixtures: a tree over each of many point sets, all grown level by level at the same time.

After Eckart, Kim, Troccoli, Kelly and Kautz, "Accelerated Generative Models for 3D Point Cloud Data", CVPR 2016: every
node is a small mixture of its own points, and a point goes down to its best child alone. A level of J children a node
then costs J Gaussians a point, where a flat mixture of as many components costs J^level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from framework.data import Float32, Float64, Int32, Int64
from framework.refinement.mixtures import mixture
from framework.refinement.mixtures.gaussian import (
    ABSENT,
    SIMD,
    constant_exponential,
    exponentials,
    log_densities,
    set_coefficients,
)
from framework.refinement.mixtures.mixture import BLOCK, MIN_SUPPORT
from framework.refinement.neighborhood import grouped

SHARE_ITERATIONS = 20  # of EM over which side a node's points are on; the error at least halves where sides are clear


@dataclass(frozen=True)
class Level:
    """M nodes of one level, below the Q nodes of the level above; above the first level are the N trees themselves.

    Siblings lie together: the children of node q are the rows `firsts[q]:firsts[q + 1]`. A node without children is a
    leaf. Weights are shares of the whole tree: those of a node's children and of the uniform component beside them
    sum to its own.
    """

    weights: Float64  # (M,) pi, above 0
    means: Float64  # (M, 3) mu, m
    covariances: Float64  # (M, 3, 3) Sigma, m^2
    firsts: Int64  # (Q + 1,)
    outlier_weights: Float64  # (Q,) pi of the uniform component among the children of node q; 0 for a leaf
    outlier_boxes: Float64  # (Q, 2, 3) m, lowest and highest corner of the box that it fills

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def parents(self) -> Int64:
        """(M,) the parent of each node: a node of the level above, at the first level a tree."""
        return np.repeat(np.arange(len(self.firsts) - 1), np.diff(self.firsts))

    @property
    def outlier_densities(self) -> Float64:
        """(Q,) of the uniform component within its box, 1 / m^3; 0 for a leaf, which has none."""
        volumes = np.prod(self.outlier_boxes[:, 1] - self.outlier_boxes[:, 0], axis=1)
        return np.asarray(np.where(volumes > 0, 1.0 / np.where(volumes > 0, volumes, 1.0), 0.0), np.float64)


@dataclass(frozen=True)
class MixtureTree:
    """The trees of N point sets."""

    levels: tuple[Level, ...]  # from the coarsest; at least one

    def passed(self, k: int, points: Float32, starts: Int64) -> Int64:
        """(S,) the best node of level `k` for each point; -1 = the uniform component is likelier than each of them.

        `points[starts[q]:starts[q + 1]]` have come down to node q of the level above.
        """
        nodes, ones, odds = np.ones(len(self.levels[k])), np.ones(len(starts) - 1), np.zeros(len(points))
        child, _ = self.shared(
            k, points, starts, nodes.astype(np.float32), ones.astype(np.float32), odds.astype(np.float32)
        )
        return child

    def shared(
        self, k: int, points: Float32, starts: Int64, shares: Float32, above: Float32, log_odds: Float32
    ) -> tuple[Int64, Float32]:
        """`passed`, and (S,) in [0, 1] how much of each point is ours by the densities of this level.

        A node is ours by its share in `shares` (M,), the uniform component below node q by `above[q]` (Q,). Our part
        of the density is multiplied by exp(`log_odds`) (S,). A point at a leaf is not ours.
        """
        level = self.levels[k]
        child, share = np.empty(len(points), np.int64), np.empty(len(points), np.float32)
        _pass_down(
            points, log_odds, *_blocks(starts), _coefficients_of(level), shares, level.firsts, _log_outliers(level),
            above, child, share,
        )  # fmt: skip
        return child, share


def fit(
    points: Float32,
    starts: Int64,
    *,
    levels: int,
    children: int,
    max_iterations: int,
    tolerance: float,
    variance_floor: float,
    outlier_fraction: float,
    min_support: float,
    min_points: int,
) -> MixtureTree:
    """Grows a tree of at most `levels` levels over each point set `points[starts[k]:starts[k + 1]]`.

    A node with `min_points` points or more gets `children` of its own, fitted to its points by `mixture.fit`, which
    `max_iterations`, `tolerance`, `variance_floor` (m^2) and `outlier_fraction` are for, from the start that `cut`
    makes. Each point then goes to its best child; one that the uniform component explains best goes no deeper. A child
    that weighs less than `min_support` in its tree is dropped, to its siblings' gain. A set with too few points has no
    nodes at all.
    """
    grown: list[Level] = []
    above = np.ones(len(starts) - 1)  # weights of the nodes that the points are at
    for _ in range(levels):
        chosen = np.nonzero(np.diff(starts) >= max(min_points, 1))[0]
        if grown and len(chosen) == 0:
            break
        own, own_starts = _ranges(points, starts, chosen)
        fitted = mixture.fit(
            own,
            own_starts,
            cut(own, own_starts, children),
            children,
            max_iterations=max_iterations,
            tolerance=tolerance,
            variance_floor=variance_floor,
            outlier_fraction=outlier_fraction,
        )
        boxes = _boxes(own, own_starts, 4 * np.sqrt(variance_floor))
        level = _level(fitted, boxes, chosen, above, min_support)
        if grown and len(level) == 0:
            break
        grown.append(level)
        if len(grown) < levels:
            child = MixtureTree((level,)).passed(0, points, starts)
            order, starts = grouped(child.astype(np.int32), len(level))
            points, above = points[order], level.weights
    return MixtureTree(tuple(grown))


def cut(points: Float32, starts: Int64, groups: int) -> Int32:
    """(S,) each set cut into at most `groups` groups in [0, groups) that lie together: a start for `mixture.fit`.

    The group of the largest scatter along one axis is cut in two at its mean, again and again (variance-based
    bisection). A group that a cut would leave with too few points for a component stays whole.
    """
    labels = np.zeros(len(points), np.int32)
    _cut_all(points, starts, groups, labels)
    return labels


def own_shares(log_odds: Float32, starts: Int64, above: Float32, above_points: float) -> Float32:
    """(M,) the share of each node that is ours, from the evidence `log_odds[starts[j]:starts[j + 1]]` of its points.

    Each point is ours or not; its evidence is the log-likelihood ratio of the two. The share rho is the likeliest one,
    max sum_i log(rho exp(o_i) + 1 - rho), as if `above_points` more points shared the parent's share `above` (M,): the
    fixed point of EM over the points' sides.
    """
    shares = above.astype(np.float32)
    _share_all(log_odds, starts, above_points, shares)
    return shares


def _level(fitted: mixture.Mixtures, boxes: Float64, chosen: Int64, above: Float64, min_support: float) -> Level:
    """The level below nodes of the weights `above` (Q,), of which the `chosen` ones have been given children."""
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
    return Level(
        weights=(weights * scale[:, None])[kept],
        means=fitted.means[kept],
        covariances=fitted.covariances[kept],
        firsts=np.concatenate([[0], np.cumsum(counts)]),
        outlier_weights=outlier_weights,
        outlier_boxes=outlier_boxes,
    )


def _ranges(points: Float32, starts: Int64, chosen: Int64) -> tuple[Float32, Int64]:
    """The points of the chosen sets alone, and where each of them begins."""
    counts = np.diff(starts)
    if len(chosen) == len(counts):
        return points, starts
    inside = np.zeros(len(counts), bool)
    inside[chosen] = True
    return points[np.repeat(inside, counts)], np.concatenate([[0], np.cumsum(counts[chosen])])


def _coefficients_of(level: Level) -> Float32:
    """(M, 10) the rows that `log_densities` takes."""
    rows = np.zeros((len(level), 10), np.float32)
    _set_all_coefficients(level.weights, level.means, level.covariances, rows)
    return rows


def _log_outliers(level: Level) -> Float32:
    """(Q,) log(pi p) of the uniform components within their boxes, ABSENT where there is none."""
    evidence = level.outlier_weights * level.outlier_densities
    return np.where(evidence > 0, np.log(np.maximum(evidence, 1e-300)), ABSENT).astype(np.float32)


def _blocks(starts: Int64) -> tuple[Int64, Int64, Int64]:
    """Each set in blocks for the kernels: (B,) the set, where the block begins and where it ends."""
    blocks = -(-np.diff(starts) // BLOCK)
    sets = np.repeat(np.arange(len(blocks)), blocks)
    begins = starts[sets] + BLOCK * (np.arange(len(sets)) - np.repeat(np.cumsum(blocks) - blocks, blocks))
    return sets, begins, np.minimum(begins + BLOCK, starts[sets + 1])


@njit(cache=True, nogil=True)
def _set_all_coefficients(weights: Float64, means: Float64, covariances: Float64, rows: Float32) -> None:
    for j in range(len(weights)):
        set_coefficients(weights[j], means[j], covariances[j], rows[j])


@njit(cache=True, nogil=True, parallel=True)
def _cut_all(points: Float32, starts: Int64, groups: int, labels: Int32) -> None:
    for k in prange(len(starts) - 1):
        if starts[k + 1] > starts[k]:
            _cut_one(points[starts[k] : starts[k + 1]], groups, labels[starts[k] : starts[k + 1]])


@njit(cache=True, nogil=True)
def _cut_one(points: Float32, groups: int, labels: Int32) -> None:
    """The members of each group lie together in `order`, so that a cut only looks at the group that it cuts."""
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
    """The members' mean and their scatter along each axis."""
    origin = points[members[0]]  # sums of offsets from a member do not cancel
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
def _boxes(points: Float32, starts: Int64, least_side: float) -> Float64:
    """(N, 2, 3) the bounding box of each set, with no side below `least_side`."""
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
def _pass_down(
    points: Float32, log_odds: Float32, nodes: Int64, begins: Int64, ends: Int64, rows: Float32, shares: Float32,
    firsts: Int64, log_outliers: Float32, above: Float32, child: Int64, share: Float32,
) -> None:  # fmt: skip
    for b in prange(len(nodes)):
        q, begin, end = nodes[b], begins[b], ends[b]
        first, last = firsts[q], firsts[q + 1]
        _pass_block(
            points[begin:end], log_odds[begin:end], rows[first:last], shares[first:last], first, log_outliers[q],
            above[q], child[begin:end], share[begin:end],
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _pass_block(
    points: Float32, log_odds: Float32, rows: Float32, shares: Float32, first: int, log_outlier: np.float32,
    above: np.float32, child: Int64, share: Float32,
) -> None:  # fmt: skip
    n, children = len(points), len(rows)
    child[:] = -1
    share[:] = 0
    if children == 0:
        return
    xyz, densities = np.empty((3, n), np.float32), np.empty((children, n), np.float32)
    for i in range(n):
        for a in range(3):
            xyz[a, i] = points[i, a]
    largest, best = np.full(n, log_outlier), np.full(n, -1, np.int32)
    for j in range(children):
        log_densities(xyz[0], xyz[1], xyz[2], rows[j], densities[j])
        _take_better(densities[j], np.int32(j), largest, best)
    for i in range(n):
        child[i] = first + best[i] if best[i] >= 0 else -1
    evidence = np.empty(n, np.float32)
    constant_exponential(log_outlier, largest, evidence, n)
    for i in range(n):
        share[i] = above * evidence[i]
    for j in range(children):
        exponentials(densities[j], largest, evidence, n)
        _add_scaled(densities[j], shares[j], share)
    for i in range(n):
        ours = share[i] * np.exp(log_odds[i])
        share[i] = ours / (ours + max(evidence[i] - share[i], np.float32(0)))


@njit(cache=True, nogil=True, fastmath=SIMD)
def _take_better(densities: Float32, j: np.int32, largest: Float32, best: Int32) -> None:
    for i in range(len(largest)):
        better = densities[i] > largest[i]
        best[i] = j if better else best[i]
        largest[i] = densities[i] if better else largest[i]


@njit(cache=True, nogil=True, fastmath=SIMD)
def _add_scaled(densities: Float32, share: np.float32, values: Float32) -> None:
    for i in range(len(values)):
        values[i] += share * densities[i]


@njit(cache=True, nogil=True, parallel=True)
def _share_all(log_odds: Float32, starts: Int64, above_points: float, shares: Float32) -> None:
    for j in prange(len(starts) - 1):
        if starts[j + 1] > starts[j]:
            ratios = np.exp(log_odds[starts[j] : starts[j + 1]])
            shares[j] = _likeliest_share(ratios, float(shares[j]), above_points)


@njit(cache=True, nogil=True)
def _likeliest_share(ratios: Float32, above: float, above_points: float) -> float:
    share = 0.5
    for _ in range(SHARE_ITERATIONS):
        ours = above_points * above
        for ratio in ratios:
            ours += share * ratio / (share * ratio + 1.0 - share)
        share = ours / (len(ratios) + above_points)
    return share
