"""Tests for refiner=dbscan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from sklearn.cluster import DBSCAN

from framework.data import Camera, Frame, PointClusters
from framework.errors import ConfigError
from plugins.refiners.dbscan import Dbscan
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


def blobs(seed: int, count: int = 1500) -> np.ndarray:
    """Return noisy points of four balls of different density, which almost touch and are far from the origin."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.4, 0.4, (4, 3))
    sigmas = rng.uniform(0.02, 0.08, 4)
    which = rng.integers(0, 4, count)
    dense = centers[which] + rng.normal(size=(count, 3)) * sigmas[which, None]
    everywhere = rng.uniform(-0.6, 0.6, (count // 5, 3))
    return (np.concatenate([dense, everywhere]) + np.array([-3, 5, 2])).astype(np.float32)


@pytest.mark.parametrize("seed", range(6))
def test_dbscan_keeps_largest_component_with_border(seed):
    """The reference is the largest cluster of scikit-learn's core points and all points within eps of these."""
    eps, min_points, points = 0.04, 12, blobs(seed)
    reference = DBSCAN(eps=eps, min_samples=min_points).fit(points)
    core = reference.core_sample_indices_
    largest = core[reference.labels_[core] == np.bincount(reference.labels_[core]).argmax()]
    right = (cdist(points.astype(np.float64), points[largest].astype(np.float64)) <= eps).any(axis=1)
    assert right[reference.labels_ == reference.labels_[largest[0]]].all()
    clusters = clusters_of(blobs(seed + 100), points)
    refined = Dbscan(eps=eps, eps_per_depth=0.0, min_points=min_points, stride=1).refine(clusters, FRAME)
    np.testing.assert_array_equal(refined.points_world[refined.cluster == 1], points[right])
    assert 0 < right.sum() < len(points)


def test_dbscan_eps_increases_with_depth():
    """The points are on a line at a depth of 2 m. Their distance is 5 cm, except for one gap of 11 cm."""
    line = np.stack([np.arange(20) * 0.05, np.zeros(20), np.full(20, 2.0)], axis=1)
    line[12:, 0] += 0.06
    for slope, kept in ((0.01, 12), (0.05, 20)):
        refined = Dbscan(eps=0.035, eps_per_depth=slope, min_points=2, stride=1).refine(clusters_of(line), FRAME)
        assert len(refined.pixels) == kept, slope


def test_dbscan_skipped_points_join_nearby_samples():
    """The larger of two plates is kept, whatever the stride."""
    v, u = np.mgrid[:60, :90]
    plates = np.stack([u * 0.01, v * 0.01, np.where(u < 50, 2.0, 2.3)], axis=-1).reshape(-1, 3)
    clusters = clusters_of(plates)
    for stride in (1, 2, 3, 5):
        refined = Dbscan(eps=0.08, eps_per_depth=0.0, min_points=4, stride=stride).refine(clusters, FRAME)
        np.testing.assert_array_equal(refined.pixels[:, 0] < 50, True)
        assert len(refined.pixels) == 60 * 50


def test_dbscan_weights_sampled_points_for_skipped_points():
    """At most 600 of 5400 points are sampled: every third row and column, with weight 9."""
    v, u = np.mgrid[:60, :90]
    plate = np.stack([u * 0.01, v * 0.01, 0 * u + 2.0], axis=-1).reshape(-1, 3)
    plate[-90:, 1] += 0.5  # the last row contains no sample and is removed
    for eps, min_points, kept in ((0.035, 9 * 3, 59 * 90), (0.035, 9 * 5 + 1, 60 * 90)):
        refiner = Dbscan(eps=eps, eps_per_depth=0.0, min_points=min_points, stride=1, max_points=600)
        assert len(refiner.refine(clusters_of(plate), FRAME).pixels) == kept, (
            "expected the weights of at most 5 samples within eps"
        )


def test_dbscan_first_of_two_equal_components_is_kept():
    rng = np.random.default_rng(0)
    ball = rng.normal(0, 0.01, (50, 3))
    for offset in (1.0, -1.0):
        refined = Dbscan(eps=0.05, min_points=5, stride=1).refine(
            clusters_of(np.concatenate([ball, ball + offset])), FRAME
        )
        np.testing.assert_array_equal(refined.pixels[:, 0], np.arange(50))


def test_dbscan_sparse_cluster_is_unchanged():
    spread = np.arange(60).reshape(20, 3) * 1.0
    assert len(Dbscan().refine(clusters_of(spread), FRAME).pixels) == 20


def test_dbscan_degenerate_clusters_are_valid():
    same = np.zeros((500, 3))
    one = np.array([[1.0, 2.0, 3.0]])
    none = np.zeros((0, 3))
    refined = Dbscan(min_points=1).refine(clusters_of(same, none, one, none), FRAME)
    assert np.bincount(refined.cluster, minlength=4).tolist() == [500, 0, 1, 0]
    assert len(refined) == 4
    assert len(Dbscan().refine(clusters_of(), FRAME)) == 0
    far = np.array([[1e6, -1e6, 1e6], [-1e6, 1e6, 0]])
    assert len(Dbscan(eps=0.001, eps_per_depth=0, min_points=1, stride=1).refine(clusters_of(far), FRAME).pixels) == 1


def test_dbscan_keeps_unassigned_points():
    clusters = clusters_of(blobs(0))
    cluster = np.where(np.arange(len(clusters.cluster)) % 3 == 0, -1, 0).astype(np.int32)
    refined = Dbscan(stride=1).refine(replace(clusters, cluster=cluster), FRAME)
    np.testing.assert_array_equal(refined.pixels[refined.cluster == -1], clusters.pixels[::3])
    assert 0 < (refined.cluster == 0).sum() < (cluster == 0).sum()


def test_dbscan_does_not_depend_on_thread_count():
    clusters = clusters_of(*(blobs(seed) for seed in range(5)))
    np.testing.assert_array_equal(*by_one_thread_and_two(lambda: Dbscan().refine(clusters, FRAME).points_world))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"eps": 0.0}, r"Dbscan\.eps: expected at least 0\.001, got 0\.0"),
        ({"eps_per_depth": float("nan")}, "Dbscan.eps_per_depth"),
        ({"min_points": 0}, "Dbscan.min_points"),
        ({"stride": 0}, "Dbscan.stride"),
    ],
)
def test_dbscan_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        Dbscan(**parameters)
