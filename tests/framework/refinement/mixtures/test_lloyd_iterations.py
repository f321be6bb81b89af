"""Lloyd's algorithm beside scikit-learn's from the same start."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.cluster import KMeans

from framework.refinement.mixtures import lloyd_iterations


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("iterations", [2, 300])
def test_same_labels_as_scikit_learn(iterations):
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


def test_depth_groups():
    points = np.array([[0, 0, 4], [1, 0, 1], [2, 0, 2], [3, 0, 3], [0, 5, 7]], np.float32)
    groups = lloyd_iterations.depth_groups(points, np.array([0, 4, 4, 5]), 2)
    np.testing.assert_allclose(groups[0], [[1.5, 0, 1.5], [1.5, 0, 3.5]])
    np.testing.assert_array_equal(groups[1], 0)
    np.testing.assert_array_equal(groups[2], [[0, 5, 7], [0, 5, 7]])


def test_a_center_without_points_stays():
    points = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    labels, centers = lloyd_iterations.cluster(points, np.array([0, 2]), np.array([[[0.5, 0, 0], [9.0, 9, 9]]]), 10)
    assert labels.tolist() == [0, 0]
    np.testing.assert_array_equal(centers[0], [[0.5, 0, 0], [9, 9, 9]])


def test_of_equally_near_centers_the_first():
    points = np.array([[0, 0, 0]], np.float32)
    centers = np.array([[[1.0, 0, 0], [-1.0, 0, 0]]])
    assert lloyd_iterations.nearest_centers(points, np.array([0]), np.array([1]), centers).tolist() == [0]
