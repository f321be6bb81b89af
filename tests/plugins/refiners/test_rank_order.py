"""Tests for refiner=rank_order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from framework.data import Camera, Frame, PointClusters
from framework.errors import ConfigError
from plugins.refiners.rank_order import RankOrder, rank_order_groups
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(90, 60, 50.0, 50.0, 44.5, 29.5)
FRAME = Frame(0, 0.0, np.zeros((60, 90, 3), np.uint8), np.full((60, 90), 2.0, np.float32), CAMERA)


def clusters_of(*sets: np.ndarray) -> PointClusters:
    """Return the point sets as clusters, at consecutive pixels of a 90x60 image."""
    points = np.concatenate([np.zeros((0, 3)), *sets]).astype(np.float32)
    ones = np.ones(len(sets), np.float32)
    at = np.concatenate([np.arange(0), *(np.arange(len(s)) for s in sets)])
    pixels = np.stack([at % 90, at // 90], axis=1).astype(np.int32)
    cluster = np.repeat(np.arange(len(sets)), [len(s) for s in sets]).astype(np.int32)
    return PointClusters(points, pixels, cluster, ones[:, None], ones, ("thing",))


def blobs(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * 0.1 + rng.uniform(-0.3, 0.3, (3, 3))[rng.integers(0, 3, count)]).astype(
        np.float32
    )


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_rank_order_separated_blobs_split_at_any_scale(scale):
    rng = np.random.default_rng(0)
    small, large = rng.normal(0, 0.05, (200, 3)), rng.normal(0, 0.05, (300, 3)) + np.array([0.0, 0.6, 0.0])
    points = (np.concatenate([small, large]) * scale).astype(np.float32)
    groups = rank_order_groups(points, 16, 1.0)
    assert not set(groups[:200]) & set(groups[200:])
    refined = RankOrder(threshold=1.5).refine(clusters_of(points), FRAME)
    at = refined.pixels[:, 1] * 90 + refined.pixels[:, 0]
    assert (at >= 200).all()
    assert len(at) > 0.9 * 300


def test_rank_order_skipped_points_join_nearest_sample():
    """At most 200 of 5400 points are sampled, one in each block of pixels."""
    v, u = np.mgrid[:60, :90]
    rng = np.random.default_rng(0)
    plates = np.stack([u * 0.01, v * 0.01, np.where(u < 50, 2.0, 2.5)], axis=-1).reshape(-1, 3)
    plates += rng.normal(0, 0.001, plates.shape)
    refined = RankOrder(threshold=2.0, max_points=200).refine(clusters_of(plates), FRAME)
    np.testing.assert_array_equal(refined.pixels[:, 0] < 50, True)
    assert len(refined.pixels) == 60 * 50
    side = 6  # px; 10 x 15 blocks; blocks of 5 px would be 12 x 18 > 200
    first = np.flatnonzero((u.ravel() % side == 0) & (v.ravel() % side == 0))
    groups = rank_order_groups(plates[first].astype(np.float32), 16, 0.6)
    nearest = cdist(plates.astype(np.float32).astype(np.float64), plates[first].astype(np.float32)).argmin(axis=1)
    right = (groups == np.bincount(groups).argmax())[nearest]
    refined = RankOrder(threshold=0.6, max_points=200).refine(clusters_of(plates), FRAME)
    np.testing.assert_array_equal(refined.pixels[:, 1] * 90 + refined.pixels[:, 0], np.flatnonzero(right))


def test_rank_order_first_of_two_equal_groups_is_kept():
    rng = np.random.default_rng(0)
    ball = rng.normal(0, 0.01, (60, 3))
    for offset in (1.0, -1.0):
        clusters = clusters_of(np.concatenate([ball, ball + offset]))
        refined = RankOrder(threshold=5.0).refine(clusters, FRAME)
        np.testing.assert_array_equal(refined.pixels[:, 1] * 90 + refined.pixels[:, 0], np.arange(60))


def test_rank_order_degenerate_clusters_are_valid():
    same, one, none = np.zeros((500, 3)), np.array([[1.0, 2.0, 3.0]]), np.zeros((0, 3))
    two = np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    refined = RankOrder().refine(clusters_of(same, none, one, two, none), FRAME)
    counts = np.bincount(refined.cluster, minlength=5).tolist()
    assert counts[0] > 0
    assert counts[1:] == [0, 1, 2, 0]
    assert len(refined) == 5
    assert len(RankOrder().refine(clusters_of(), FRAME)) == 0


def test_rank_order_keeps_unassigned_points():
    clusters = clusters_of(blobs(0, 900))
    cluster = np.where(np.arange(900) % 3 == 0, -1, 0).astype(np.int32)
    refined = RankOrder(threshold=0.3).refine(replace(clusters, cluster=cluster), FRAME)
    np.testing.assert_array_equal(refined.pixels[refined.cluster == -1], clusters.pixels[::3])
    assert 0 < (refined.cluster == 0).sum() < 600


def test_rank_order_does_not_depend_on_thread_count():
    clusters = clusters_of(*(blobs(seed, 1500) for seed in range(5)))
    np.testing.assert_array_equal(*by_one_thread_and_two(lambda: RankOrder().refine(clusters, FRAME).points_world))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"neighbors": 1}, r"RankOrder\.neighbors: expected a value in \[2, 254\], got 1"),
        ({"neighbors": 255}, "RankOrder.neighbors"),
        ({"threshold": float("nan")}, "RankOrder.threshold"),
        ({"max_points": 9}, "RankOrder.max_points"),
    ],
)
def test_rank_order_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        RankOrder(**parameters)


def neighbor_order(points: np.ndarray) -> list[list[int]]:
    """Return the points sorted by their distance from each point, beginning with the point itself.

    Ties are by index.
    """
    distances = ((points[:, None].astype(np.float64) - points[None]) ** 2).sum(axis=-1)
    np.fill_diagonal(distances, -1)
    return [sorted(range(len(points)), key=lambda b, row=row: (row[b], b)) for row in distances]


def slow_groups(points: np.ndarray, k: int, threshold: float) -> np.ndarray:
    """Return the groups (N,) by the definition of rank-order clustering."""
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


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    pairs = np.unique(np.stack([a, b]), axis=1).shape[1]
    return pairs == len(np.unique(a)) == len(np.unique(b))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 0.7, 1.0, 1.5])
@pytest.mark.parametrize(("points", "k"), [(blobs(0, 70), 6), (blobs(1, 50), 9), (blobs(2, 60), 3), (blobs(3, 8), 9)])
def test_rank_order_groups_match_reference(points, k, threshold):
    assert same_partition(rank_order_groups(points, k, threshold), slow_groups(points, k, threshold))


def test_rank_order_reference_splits_test_data():
    """In the comparison with the reference, there must be several groups of several points."""
    for points, k in ((blobs(0, 70), 6), (blobs(1, 50), 9), (blobs(2, 60), 3)):
        assert 1 < len(np.unique(slow_groups(points, k, 0.5))) < len(points) // 2
