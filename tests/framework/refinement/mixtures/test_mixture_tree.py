"""Tests for mixture trees, compared with a slow recursion and with flat mixtures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from framework.refinement.mixtures import mixture, mixture_tree
from framework.refinement.mixtures.mixture_kernels import MIN_SUPPORT, EmSettings
from framework.refinement.mixtures.mixture_tree import Level, MixtureTree
from tests.support.thread_counts import by_one_thread_and_two
from tests.support.tree_densities import gaussian_densities, leaves, log_likelihoods, owners

FLOOR = 0.02**2  # m^2


def surface(seed: int, count: int) -> np.ndarray:
    """Return the points (count, 3), m, of a wavy surface with a step about 2 m away. 2 % of the points are outliers."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-1, 1, (2, count))
    z = 2 + 0.4 * np.sin(3 * u) * np.cos(2 * v) + np.where(u > 0.2, 0.5, 0.0)
    points = np.stack([u, v, z], axis=1) + rng.normal(0, 0.01, (count, 3))
    stray = rng.random(count) < 0.02
    return np.where(stray[:, None], rng.uniform(-1.5, 3.5, (count, 3)), points).astype(np.float32)


def grown(points: np.ndarray, starts: np.ndarray, **changed: float) -> MixtureTree:
    parameters = {"levels": 3, "children": 8, "max_iterations": 8, "min_support": 1e-4, "min_points": 32} | changed
    settings = EmSettings(parameters.pop("max_iterations"), -np.inf, FLOOR, 0.02)
    return mixture_tree.fit(points, starts, settings, **parameters)


# Reference for the recursion of the paper


def slow_cut(points: np.ndarray, groups: int) -> np.ndarray:
    labels, closed = np.zeros(len(points), int), set()
    while labels.max() + 1 < groups:
        scatters = {g: ((points[labels == g] - points[labels == g].mean(axis=0)) ** 2).sum(axis=0)
                    for g in range(labels.max() + 1) if g not in closed}  # fmt: skip
        g = max(scatters, key=lambda g: scatters[g].max())
        axis = scatters[g].argmax()
        upper = (labels == g) & (points[:, axis] > points[labels == g, axis].mean())
        if upper.sum() < MIN_SUPPORT or (labels == g).sum() - upper.sum() < MIN_SUPPORT:
            closed.add(g)
            continue
        labels[upper] = labels.max() + 1
    return labels


def floored(Sigma: np.ndarray) -> np.ndarray:
    values, axes = np.linalg.eigh(Sigma)
    return axes @ np.diag(np.maximum(values, FLOOR)) @ axes.T


@dataclass
class SlowNode:
    """Gaussian with its weight and points. `children` is empty unless the node is expanded."""

    weight: float
    mean: np.ndarray
    Sigma: np.ndarray
    points: np.ndarray
    children: list[SlowNode]


def slow_children(points: np.ndarray, weight: float, children: int, iterations: int) -> tuple[list[SlowNode], float]:
    labels = slow_cut(points, children)
    gamma = np.stack([0.98 * (labels == k) for k in range(labels.max() + 1)], axis=1)
    outlier = 0.02
    sides = np.maximum(np.ptp(points, axis=0), 4 * np.sqrt(FLOOR))
    for step in range(iterations + 1):
        N_k = gamma.sum(axis=0)
        weights, means = N_k / len(points), gamma.T @ points / N_k[:, None]
        offsets = points[:, None] - means
        Sigmas = [floored(S) for S in np.einsum("sk,ska,skb->kab", gamma, offsets, offsets) / N_k[:, None, None]]
        densities = gaussian_densities(points, weights, means, np.array(Sigmas))
        evidence = densities.sum(axis=1) + outlier / np.prod(sides)
        if step < iterations:
            gamma = densities / evidence[:, None]
            outlier = (outlier / np.prod(sides) / evidence).mean()
    best = np.where(densities.max(axis=1) > outlier / np.prod(sides), densities.argmax(axis=1), -1)
    total = weights.sum() + outlier
    nodes = [
        SlowNode(weight * weights[k] / total, means[k], Sigmas[k], points[best == k], []) for k in range(len(means))
    ]
    return nodes, weight * outlier / total


@pytest.mark.parametrize("seed", [0, 1])
def test_mixture_tree_matches_slow_recursion(seed):
    points = surface(seed, 700).astype(np.float64)
    nodes, outlier = slow_children(points, 1.0, 4, 6)
    below = [slow_children(node.points, node.weight, 4, 6) for node in nodes]
    tree = grown(points.astype(np.float32), np.array([0, 700]), levels=2, children=4, max_iterations=6)
    slow_levels = [nodes, [child for children, _ in below for child in children]]
    for level, expected in zip(tree.levels, slow_levels, strict=True):
        np.testing.assert_allclose(level.weights, [node.weight for node in expected], rtol=2e-3)
        np.testing.assert_allclose(level.means, [node.mean for node in expected], atol=1e-3)
        np.testing.assert_allclose(level.covariances, [node.Sigma for node in expected], rtol=5e-3, atol=1e-5)
    np.testing.assert_allclose(tree.levels[0].outlier_weights, [outlier], rtol=5e-3)
    np.testing.assert_allclose(tree.levels[1].outlier_weights, [o for _, o in below], rtol=5e-3, atol=1e-6)
    np.testing.assert_array_equal(tree.levels[1].parents, np.repeat(np.arange(4), [len(c) for c, _ in below]))


def test_mixture_tree_single_level_equals_flat_mixture():
    points, starts = surface(2, 3000), np.array([0, 1000, 3000])
    tree = grown(points, starts, levels=1, min_support=0.0)
    flat = mixture.fit(
        points, starts, mixture_tree.cut(points, starts, 8), 8, EmSettings(8, -np.inf, FLOOR, 0.02),
    )  # fmt: skip
    there = flat.weights > 0
    totals = flat.weights.sum(axis=1) + flat.outlier_weights
    np.testing.assert_allclose(tree.levels[0].weights, (flat.weights / totals[:, None])[there], rtol=1e-12)
    np.testing.assert_array_equal(tree.levels[0].means, flat.means[there])
    np.testing.assert_array_equal(tree.levels[0].covariances, flat.covariances[there])
    np.testing.assert_allclose(tree.levels[0].outlier_densities, flat.outlier_densities, rtol=1e-6)
    more = mixture.fit(
        points, starts, mixture_tree.cut(points, starts, 8), 8, EmSettings(9, -np.inf, FLOOR, 0.02),
    )  # the last E-step uses the parameters after eight steps  # fmt: skip
    np.testing.assert_allclose(log_likelihoods(tree, points, starts), more.log_likelihoods, atol=1e-4)


def masses(tree: MixtureTree, depth: int, sets: int) -> np.ndarray:
    """Return the total weight (sets,) of the leaves and uniform components in each tree."""
    mass = np.zeros(sets)
    for k, rows in leaves(tree, depth):
        np.add.at(mass, owners(tree, k)[rows], tree.levels[k].weights[rows])
    above = np.arange(sets)
    for k in range(depth):
        np.add.at(mass, above, tree.levels[k].outlier_weights)
        above = owners(tree, k)
    return mass


@pytest.mark.parametrize("min_support", [0.0, 0.001])
def test_mixture_tree_weights_sum_to_one(min_support):
    points, starts = surface(3, 6000), np.array([0, 2000, 6000])
    tree = grown(points, starts, min_support=min_support)
    assert len(tree.levels) == 3
    for above, level in zip(tree.levels[:-1], tree.levels[1:], strict=True):
        children = np.bincount(level.parents, level.weights, len(above)) + level.outlier_weights
        expanded = np.diff(level.firsts) > 0
        assert expanded.any()
        np.testing.assert_allclose(children[expanded], above.weights[expanded], rtol=1e-12)
        assert not level.outlier_weights[~expanded].any(), "expected no uniform component in a leaf"
        assert (level.weights >= min_support).all()
    for depth in (1, 2, 3):
        np.testing.assert_allclose(masses(tree, depth, 2), 1, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_mixture_tree_likelihood_increases_with_depth(seed):
    points, starts = surface(seed, 6000), np.array([0, 2000, 6000])
    tree = grown(points, starts)
    by_depth = np.array([log_likelihoods(tree, points, starts, depth) for depth in (1, 2, 3)])
    assert (np.diff(by_depth, axis=0) > 0).all(), by_depth


def test_mixture_tree_assigns_points_to_best_child():
    """Each point is assigned to the most likely node, and an outlier to -1."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 5, 5], [0.4, 0, 0]], np.float32)
    level = Level(
        weights=np.array([0.3, 0.5]), means=np.array([[0.0, 0, 0], [1.0, 0, 0]]),
        covariances=np.array([0.04 * np.eye(3)] * 2), firsts=np.array([0, 2]), outlier_weights=np.array([0.2]),
        outlier_boxes=np.array([[[-5.0, -5, -5], [5, 5, 5]]]),
    )  # fmt: skip
    odds = np.array([0.0, 0.0, 0.0, 1.5], np.float32)
    shares = np.array([0.9, 0.25], np.float32)
    tree, starts = MixtureTree((level,)), np.array([0, 4])
    child, share = tree.best_nodes_with_posteriors(0, points, starts, shares, np.array([0.6], np.float32), odds)
    assert child.tolist() == tree.best_nodes(0, points, starts).tolist() == [0, 1, -1, 0]
    densities = gaussian_densities(points.astype(np.float64), level.weights, level.means, level.covariances)
    ours = (densities @ shares + 0.6 * 0.2 / 1000) * np.exp(odds)
    theirs = densities @ (1 - shares) + 0.4 * 0.2 / 1000
    np.testing.assert_allclose(share, ours / (ours + theirs), atol=1e-5)


def test_mixture_tree_own_ratios_maximize_likelihood():
    rng = np.random.default_rng(0)
    odds = rng.normal(0.4, 1.5, 60).astype(np.float32)
    starts = np.array([0, 60, 60, 63, 66])
    odds = np.concatenate([odds, np.full(3, 2.0), np.full(3, -2.0)]).astype(np.float32)
    above = np.array([0.5, 0.7, 0.5, 0.5], np.float32)
    shares = mixture_tree.own_ratios(odds, starts, above, 4.0)
    grid = np.linspace(1e-4, 1 - 1e-4, 20001)
    ratios = np.exp(odds[:60].astype(np.float64))[:, None]
    objective = np.log(grid * ratios + 1 - grid).sum(axis=0) + 4 * (0.5 * np.log(grid) + 0.5 * np.log(1 - grid))
    assert shares[0] == pytest.approx(grid[objective.argmax()], abs=2e-3)
    assert shares[1] == pytest.approx(0.7), "expected the parent's ratio for a node without points"
    leaning = mixture_tree.own_ratios(odds, starts, np.full(4, 0.9, np.float32), 4.0)
    objective += 4 * (0.4 * np.log(grid) - 0.4 * np.log(1 - grid))
    assert leaning[0] == pytest.approx(grid[objective.argmax()], abs=2e-3)
    assert shares[2] > 0.6 > 0.4 > shares[3]
    assert shares[2] + shares[3] == pytest.approx(1.0, abs=1e-5), "expected complementary ratios for opposite log-odds"


def test_mixture_tree_cut_matches_slow_reference():
    points = surface(5, 500)
    starts = np.array([0, 300, 300, 500])
    for groups in (2, 8, 13):
        labels = mixture_tree.cut(points, starts, groups)
        np.testing.assert_array_equal(labels[:300], slow_cut(points[:300].astype(np.float64), groups))
        np.testing.assert_array_equal(labels[300:], slow_cut(points[300:].astype(np.float64), groups))
    assert not mixture_tree.cut(np.ones((50, 3), np.float32), np.array([0, 50]), 8).any(), (
        "expected one group for equal points"
    )


def test_mixture_tree_degenerate_sets_have_at_most_one_node():
    points = np.concatenate([np.ones((40, 3)), surface(0, 200), np.zeros((1, 3))]).astype(np.float32)
    starts = np.array([0, 0, 40, 240, 241])
    tree = grown(points, starts, levels=2)
    assert np.diff(tree.levels[0].firsts)[[0, 3]].tolist() == [0, 0], (
        "expected no nodes for an empty set and a single point"
    )
    assert np.diff(tree.levels[0].firsts)[1] == 1, "expected one node for forty equal points"
    found = log_likelihoods(tree, points, starts)
    assert found[0] == 0.0
    assert np.isfinite(found[1:3]).all()
    assert found[3] == -np.inf
    nothing = grown(np.zeros((0, 3), np.float32), np.array([0]))
    assert len(log_likelihoods(nothing, np.zeros((0, 3), np.float32), np.array([0]))) == 0


def test_mixture_tree_is_independent_of_thread_count():
    points, starts = surface(3, 6000), np.array([0, 2000, 6000])

    def grow():
        tree = grown(points, starts)
        return tree.levels[-1].means, log_likelihoods(tree, points, starts)

    for one, other in zip(*by_one_thread_and_two(grow), strict=True):
        np.testing.assert_array_equal(one, other)
