"""Rank-order clustering beside its definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from framework.refinement.rank_order_clustering import rank_order_groups


def neighbor_order(points: np.ndarray) -> list[list[int]]:
    """All points in the order of their distance from each one; itself first, of equally near the first."""
    distances = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    np.fill_diagonal(distances, -1)
    return [sorted(range(len(points)), key=lambda b, row=row: (row[b], b)) for row in distances]


def slow_groups(points: np.ndarray, k: int, threshold: float) -> np.ndarray:
    """The definition, word by word."""
    order = neighbor_order(points)
    n = len(points)

    def d(a: int, b: int) -> int:
        last = min(order[a].index(b), k)
        return sum(order[b].index(order[a][i]) > k for i in range(1, last + 1))

    linked = np.zeros((n, n), bool)
    for a in range(n):
        for b in range(n):
            smaller = min(order[a].index(b), order[b].index(a))
            linked[a, b] = 0 < smaller <= k and (d(a, b) + d(b, a)) / smaller <= threshold
    return np.asarray(connected_components(linked)[1])


def blobs(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * 0.1 + rng.uniform(-0.3, 0.3, (3, 3))[rng.integers(0, 3, count)]).astype(
        np.float32
    )


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    pairs = np.unique(np.stack([a, b]), axis=1).shape[1]
    return pairs == len(np.unique(a)) == len(np.unique(b))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 0.7, 1.0, 1.5])
@pytest.mark.parametrize(("points", "k"), [(blobs(0, 70), 6), (blobs(1, 50), 9), (blobs(2, 60), 3), (blobs(3, 8), 9)])
def test_groups_are_those_of_the_definition(points, k, threshold):
    assert same_partition(rank_order_groups(points, k, threshold), slow_groups(points, k, threshold))


def test_the_definition_splits_the_sets_that_are_compared():
    """Neither one group nor as many as points: the comparison above says something."""
    for points, k in ((blobs(0, 70), 6), (blobs(1, 50), 9), (blobs(2, 60), 3)):
        assert 1 < len(np.unique(slow_groups(points, k, 0.5))) < len(points) // 2
