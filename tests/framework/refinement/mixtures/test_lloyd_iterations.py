"""Tests for Lloyd's algorithm, compared with scikit-learn, and for the start labels."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from sklearn.cluster import KMeans

from framework.refinement.mixtures import lloyd_iterations
from framework.refinement.mixtures.lloyd_iterations import start_labels
from framework.refinement.neighborhood import Neighborhoods


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("iterations", [2, 300])
def test_lloyd_cluster_labels_match_scikit_learn(iterations):
    rng = np.random.default_rng(0)
    counts = [500, 800, 1200]
    points = rng.normal([0, 0, 2], [0.5, 0.3, 0.2], (sum(counts), 3)).astype(np.float32)
    starts = np.cumsum([0, *counts])
    centers = lloyd_iterations.depth_groups(points, starts, 4)
    _, ours = lloyd_iterations.cluster(points, starts, centers, iterations)
    labels = lloyd_iterations.nearest_centers(points, starts[:-1], starts[1:], ours)
    for k in range(3):
        own = points[starts[k] : starts[k + 1]].astype(np.float64)
        reference = KMeans(4, init=centers[k], n_init=1, max_iter=iterations, tol=0.0, algorithm="lloyd").fit(own)
        np.testing.assert_array_equal(labels[starts[k] : starts[k + 1]], reference.labels_)
        np.testing.assert_allclose(ours[k], reference.cluster_centers_, atol=1e-6)


def test_depth_groups_are_means_of_equal_parts():
    points = np.array([[0, 0, 4], [1, 0, 1], [2, 0, 2], [3, 0, 3], [0, 5, 7]], np.float32)
    groups = lloyd_iterations.depth_groups(points, np.array([0, 4, 4, 5]), 2)
    np.testing.assert_allclose(groups[0], [[1.5, 0, 1.5], [1.5, 0, 3.5]])
    np.testing.assert_array_equal(groups[1], 0)
    np.testing.assert_array_equal(groups[2], [[0, 5, 7], [0, 5, 7]])


def test_lloyd_cluster_empty_center_is_unchanged():
    points = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    labels, centers = lloyd_iterations.cluster(points, np.array([0, 2]), np.array([[[0.5, 0, 0], [9.0, 9, 9]]]), 10)
    assert labels.tolist() == [0, 0]
    np.testing.assert_array_equal(centers[0], [[0.5, 0, 0], [9, 9, 9]])


def test_nearest_centers_tie_returns_first_center():
    points = np.array([[0, 0, 0]], np.float32)
    centers = np.array([[[1.0, 0, 0], [-1.0, 0, 0]]])
    assert lloyd_iterations.nearest_centers(points, np.array([0]), np.array([1]), centers).tolist() == [0]


def around(counts: list[tuple[int, int]]) -> tuple[Neighborhoods, np.ndarray]:
    """Return neighborhoods with the given numbers of (mask, ring) points, and the log-odds of the points.

    The points are in four blobs. The log-odds are negative for the points in a ring and for a third of the others.
    """
    rng = np.random.default_rng(0)
    masks, rings = np.transpose(counts)
    starts = np.concatenate([[0], np.cumsum(masks + rings)])
    points = (
        rng.normal(0, 0.1, (starts[-1], 3))
        + rng.uniform([-1, -1, 1], [1, 1, 3], (4, 3))[rng.integers(0, 4, starts[-1])]
    )
    of_ring = np.concatenate([np.repeat([False, True], pair) for pair in counts])
    log_odds = np.where(of_ring | (rng.random(starts[-1]) < 0.3), -1, 1).astype(np.float32)
    n = len(counts)
    sets = Neighborhoods(
        points.astype(np.float32), np.zeros(starts[-1], np.float32), starts, masks, np.ones(n, np.int64),
        np.ones(n, np.float32),
    )  # fmt: skip
    return sets, log_odds


def groups_of(points: np.ndarray, groups: int, iterations: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the labels and centers of Lloyd's algorithm. The start centers are the means of equal parts by depth."""
    by_depth = points[np.argsort(points[:, 2], kind="stable")]
    cuts = np.arange(groups + 1) * len(points) // groups
    centers = np.array([by_depth[a:b].mean(axis=0) for a, b in pairwise(cuts)])
    for _ in range(iterations):
        labels = nearest(points, centers)
        centers = np.array([points[labels == j].mean(axis=0) for j in range(groups)])
    return labels, centers


def nearest(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - centers, axis=-1).argmin(axis=1)


@pytest.mark.integration
@pytest.mark.parametrize("iterations", [1, 5])
def test_start_labels_match_reference_for_core_ring_and_border(iterations):
    sets, log_odds = around([(400, 300), (150, 600)])
    labels = start_labels(sets, log_odds, 2, 5, iterations)
    for k in range(2):
        own = slice(sets.starts[k], sets.starts[k + 1])
        points, found = sets.points_camera[own].astype(np.float64), labels[own]
        ring = sets.of_ring[own]
        core = ~ring & (log_odds[own] >= 0)
        np.testing.assert_array_equal(found[core], groups_of(points[core], 2, iterations)[0])
        background, centers = groups_of(points[ring], 5, iterations)
        np.testing.assert_array_equal(found[ring], 2 + background)
        border = ~ring & ~core
        assert border.any()
        np.testing.assert_array_equal(found[border], 2 + nearest(points[border], centers))


@pytest.mark.integration
def test_start_labels_of_sets_without_mask_or_ring_are_valid():
    sets, log_odds = around([(0, 50), (50, 0), (0, 0), (1, 1)])
    labels = start_labels(sets, log_odds, 2, 6, 5)
    assert ((labels >= 0) & (labels < 8)).all()
    assert (labels[:50] >= 2).all()


def test_start_labels_without_background_are_all_object():
    sets, log_odds = around([(400, 0), (150, 0)])
    labels = start_labels(sets, log_odds, 3, 0, 5)
    for k in range(2):
        own = slice(sets.starts[k], sets.starts[k + 1])
        points = sets.points_camera[own].astype(np.float64)
        np.testing.assert_array_equal(labels[own], groups_of(points, 3, 5)[0])
