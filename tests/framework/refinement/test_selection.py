"""Dropping points, beside boolean indexing."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import PointClusters
from framework.refinement.selection import keep_points
from framework.refinement.selection_kernels import PART


@pytest.mark.parametrize("points", [0, 1, PART - 1, PART, PART + 1, 3 * PART + 100])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_keeps_the_rows_of_boolean_indexing(points, share):
    rng = np.random.default_rng(0)
    ones = np.ones(3, np.float32)
    clusters = PointClusters(
        rng.normal(size=(points, 3)).astype(np.float32),
        rng.integers(0, 640, (points, 2)).astype(np.int32),
        rng.integers(-1, 3, points).astype(np.int32),
        ones[:, None],
        ones,
        ("thing",),
    )
    kept = rng.random(points) < share
    left = keep_points(clusters, kept)
    np.testing.assert_array_equal(left.points_world, clusters.points_world[kept])
    np.testing.assert_array_equal(left.pixels, clusters.pixels[kept])
    np.testing.assert_array_equal(left.cluster, clusters.cluster[kept])
    assert left.scores is clusters.scores
    assert left.class_probabilities is clusters.class_probabilities
