"""Tests for the association of point clusters with instances."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.data import PointClusters
from framework.errors import DataError
from framework.mapping.instances.association import class_agreement, match_one_to_one
from framework.mapping.instances.overlaps import OverlapRule, Overlaps, count_overlaps
from framework.mapping.labels.pixel_lists import (
    PixelLists,
    keep_on_top,
    list_points_by_pixel,
    remove_supports,
)

SHAPE = (4, 5)


def clusters_of(masks: list[np.ndarray], scores: list[float]) -> PointClusters:
    """Return the point clusters of these (4, 5) masks. All world positions are zero."""
    cluster, v, u = np.nonzero(np.array(masks))
    return PointClusters(
        points_world=np.zeros((len(u), 3), np.float32),
        pixels=np.stack([u, v], axis=1).astype(np.int32),
        cluster=cluster.astype(np.int32),
        class_probabilities=np.full((len(masks), 2), 0.5, np.float32),
        scores=np.array(scores, np.float32),
        classes=("a", "b"),
    )


def overlaps_of(clusters: PointClusters, seen: np.ndarray, stride: int = 1) -> Overlaps:
    """Return the overlaps of the clusters with instances. `seen` has every stride-th pixel of the image."""
    points = list_points_by_pixel(clusters, (stride * seen.shape[0], stride * seen.shape[1]))
    return count_overlaps(points, seen, stride)


def columns(first: int, last: int) -> np.ndarray:
    mask = np.zeros(SHAPE, np.bool_)
    mask[:, first:last] = True
    return mask


def test_overlap_votes_count_shared_pixels() -> None:
    seen = np.zeros(SHAPE, np.int32)
    seen[:, :2] = 7
    seen[:, 4] = 3
    overlaps = overlaps_of(clusters_of([columns(0, 3), columns(3, 5), columns(2, 3)], [1, 1, 1]), seen)
    assert overlaps.instance_ids.tolist() == [3, 7]
    assert overlaps.visible.tolist() == [4, 8]
    assert overlaps.sizes.tolist() == [12, 8, 4]
    assert overlaps.votes.tolist() == [[0, 8], [4, 0], [0, 0]]
    assert overlaps.over_smaller(min_pixels=1).tolist() == [[0, 1], [1, 0], [0, 0]]
    assert overlaps.over_union(min_pixels=1).tolist() == [[0, 8 / 12], [4 / 8, 0], [0, 0]]
    assert overlaps.over_union(min_pixels=16).tolist() == [[0, 8 / 16], [4 / 16, 0], [0, 0]]
    assert overlaps.over_smaller(min_pixels=16).tolist() == [[0, 0.5], [0.25, 0], [0, 0]]
    assert overlaps.by(OverlapRule.CLUSTER, min_pixels=1).tolist() == [[0, 8 / 12], [4 / 8, 0], [0, 0]]
    assert overlaps.by(OverlapRule.CLUSTER, min_pixels=16).tolist() == [[0, 0.5], [0.25, 0], [0, 0]]


def test_class_agreement_is_bhattacharyya_coefficient() -> None:
    clusters = np.float32([[1, 0, 0], [0.5, 0.5, 0]])
    instances = np.float32([[1, 0, 0], [0, 0, 1]])
    assert np.allclose(class_agreement(clusters, instances), [[1, 0], [0.5**0.5, 0]])


def best_first(overlap: np.ndarray, threshold: float) -> np.ndarray:
    """Match the largest overlap above `threshold` first, and return the instance of each cluster, -1 = none."""
    return match_one_to_one(overlap > threshold, overlap)


def test_overlaps_without_instances_or_clusters_are_empty() -> None:
    seen = np.zeros(SHAPE, np.int32)
    assert overlaps_of(clusters_of([columns(0, 2)], [1]), seen).votes.shape == (1, 0)
    empty = PointClusters(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 2), np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 2), np.float32),
        np.zeros(0, np.float32),
        ("a", "b"),
    )
    assert overlaps_of(empty, seen).votes.shape == (0, 0)
    assert len(best_first(overlaps_of(empty, seen + 1).over_smaller(min_pixels=1), 0.3)) == 0


def test_overlaps_with_stride_match_full_resolution() -> None:
    seen = np.zeros((8, 8), np.int32)
    seen[:, 4:] = 3
    pixels = np.stack(np.meshgrid(np.arange(2, 8), np.arange(8)), axis=-1).reshape(-1, 2).astype(np.int32)
    n = len(pixels)
    one = np.ones((1, 1), np.float32)
    clusters = PointClusters(np.zeros((n, 3), np.float32), pixels, np.zeros(n, np.int32), one, one[0], ("object",))
    all_pixels, sampled = overlaps_of(clusters, seen), overlaps_of(clusters, seen[::2, ::2].copy(), 2)
    kept = (pixels < 7).all(axis=1)
    smaller = replace(
        clusters,
        points_world=clusters.points_world[kept],
        pixels=pixels[kept],
        cluster=clusters.cluster[kept],
    )
    # the samples are the same pixels
    odd = count_overlaps(list_points_by_pixel(smaller, (7, 7)), seen[:7:2, :7:2].copy(), 2)
    for name in ("instance_ids", "visible", "sizes", "votes"):
        assert getattr(sampled, name).tolist() == getattr(all_pixels, name).tolist(), name
        assert getattr(odd, name).tolist() == getattr(sampled, name).tolist(), name


def test_match_prefers_best_overlap_and_is_one_to_one() -> None:
    overlap = np.array([[0.6, 0.9], [0.0, 0.8], [0.3, 0.2]])
    assert best_first(overlap, 0.35).tolist() == [1, -1, -1]
    assert best_first(overlap, 0.25).tolist() == [1, -1, 0]


def test_overlap_min_pixels_prevents_match_with_stray_pixels() -> None:
    seen = np.zeros(SHAPE, np.int32)
    seen[:, :3] = 1  # the object, which the cluster mostly covers
    seen[0, 0] = 2  # a single voxel of another instance
    overlaps = overlaps_of(clusters_of([columns(0, 2)], [1]), seen)
    assert best_first(overlaps.over_smaller(min_pixels=1), 0.35).tolist() == [1], (
        "expected a match with the stray pixel: 1/1 exceeds 7/8"
    )
    assert best_first(overlaps.over_smaller(min_pixels=4), 0.35).tolist() == [0]


def test_match_does_not_assign_table_to_book_on_top() -> None:
    """The mask of the table covers the book and most of the table."""
    seen = np.full(SHAPE, 1, np.int32)
    seen[:, 2] = 2  # the book
    overlaps = overlaps_of(clusters_of([columns(0, 4), columns(2, 3)], [1, 1]), seen)
    smaller = overlaps.over_smaller(min_pixels=1)
    assert smaller[0].argmax() != 0, "expected the table to match the book by the overlap over the smaller area"
    assert match_one_to_one(smaller > 0.35, overlaps.over_union(min_pixels=1)).tolist() == [0, 1]


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000))
def test_match_is_independent_of_detection_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    overlap = rng.permutation(np.linspace(0, 1, 20)).reshape(5, 4)  # no ties
    order = rng.permutation(5)
    assert (best_first(overlap, 0.4)[order] == best_first(overlap[order], 0.4)).all()


@pytest.mark.parametrize("pixel", [(-1, 0), (0, -1), (5, 0), (0, 4)])
def test_points_by_pixel_outside_image_raise(pixel: tuple[int, int]) -> None:
    clusters = clusters_of([columns(0, 2)], [1])
    clusters.pixels[3] = pixel
    with pytest.raises(DataError, match="image of 5x4"):
        list_points_by_pixel(clusters, SHAPE)


def test_association_ignores_points_without_cluster() -> None:
    clusters = clusters_of([columns(0, 3), columns(1, 4)], [1, 0.5])
    clusters.cluster[clusters.pixels[:, 0] == 1] = -1
    seen = np.full(SHAPE, 4, np.int32)
    overlaps = overlaps_of(clusters, seen)
    assert overlaps.sizes.tolist() == [8, 8]
    assert overlaps.votes.tolist() == [[8], [8]]
    points = list_points_by_pixel(clusters, SHAPE)
    assert (points.list_ids > 0).any(axis=0).tolist() == [True, False, True, True, False]


def clusters_at(points: PixelLists) -> list[list[int]]:
    """Return the clusters in the list of each pixel, row by row."""
    lists = [points.clusters[first:last].tolist() for first, last in pairwise(points.offsets.tolist())]
    assert points.pixel_counts.tolist() == np.bincount(points.list_ids.ravel(), minlength=len(lists)).tolist()
    return [lists[i] for i in points.list_ids.ravel()]


def test_keep_on_top_assigns_pixels_to_smaller_object() -> None:
    table, book = columns(0, 5), columns(2, 3)
    clusters = clusters_of([table, book], [0.9, 0.2])
    points = list_points_by_pixel(clusters, SHAPE)
    ids = np.int32([7, 9])
    assert clusters_at(keep_on_top(points, ids, 0.25)) == 4 * [[0], [0], [1], [0], [0]]
    assert clusters_at(keep_on_top(points, ids, 0.2)) == 4 * [[0], [0], [0, 1], [0], [0]]
    unmatched = keep_on_top(points, np.int32([7, 0]), 0.25)
    assert clusters_at(unmatched) == 4 * [[0], [0], [0], [0], [0]], "expected no pixels for an unmatched cluster"
    assert clusters_at(points) == 4 * [[0], [0], [0, 1], [0], [0]], "expected unchanged input lists"


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000))
def test_points_by_pixel_keep_point_order(seed: int) -> None:
    """The points have random order. Some belong to no cluster, and some are duplicates."""
    rng = np.random.default_rng(seed)
    clusters = clusters_of([rng.random(SHAPE) < filled for filled in rng.random(4)], [1] * 4)
    count = len(clusters.cluster)
    order = rng.permutation(np.append(np.arange(count), rng.integers(0, count, 5 if count else 0)))
    clusters = replace(
        clusters,
        points_world=clusters.points_world[order],
        pixels=clusters.pixels[order],
        cluster=np.where(rng.random(len(order)) < 0.1, -1, clusters.cluster[order]).astype(np.int32),
    )
    expected = [[] for _ in range(SHAPE[0] * SHAPE[1])]
    for (u, v), k in zip(clusters.pixels.tolist(), clusters.cluster.tolist(), strict=True):
        if k >= 0:
            expected[v * SHAPE[1] + u].append(k)
    points = list_points_by_pixel(clusters, SHAPE)
    assert clusters_at(points) == expected
    used = [tuple(found) for found in expected]
    assert (points.pixel_counts > 0).sum() == len({*used, ()}) - (() not in used), (
        "expected one list for each set of clusters"
    )


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_keep_on_top_matches_reference(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    masks = [rng.random(SHAPE) < filled for filled in rng.random(4)]
    clusters = clusters_of(masks, [1] * 4)
    clusters.cluster[rng.random(len(clusters.cluster)) < 0.1] = -1
    points = list_points_by_pixel(clusters, SHAPE)
    ids = rng.integers(0, 3, 4).astype(np.int32)
    sizes = [int((clusters.cluster == k).sum()) for k in range(4)]
    expected = []
    for at_pixel in clusters_at(points):
        small = [sizes[k] for k in at_pixel if ids[k]]
        expected.append([k for k in at_pixel if ids[k] and all(size >= share * sizes[k] for size in small)])
    assert clusters_at(keep_on_top(points, ids, share)) == expected


@pytest.mark.parametrize("seed", range(4))
def test_remove_supports_matches_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    clusters = clusters_of([rng.random(SHAPE) < filled for filled in rng.random(4)], [1] * 4)
    points = list_points_by_pixel(clusters, SHAPE)
    stride = 1 + seed % 2
    instance_ids = np.int32([2, 5, 2**20])
    column = rng.integers(-1, 3, tuple(-(-side // stride) for side in SHAPE))
    seen = np.append(instance_ids, np.int32(0))[column]
    supported = rng.random((4, 3)) < 0.4
    expected = []
    for pixel, at_pixel in enumerate(clusters_at(points)):
        v, u = divmod(pixel, SHAPE[1])
        m = column[v // stride, u // stride]
        expected.append([k for k in at_pixel if m < 0 or not supported[k, m]])
    assert clusters_at(remove_supports(points, supported, instance_ids, seen, stride)) == expected
    on_top = keep_on_top(points, np.int32([3, 0, 1, 2]), 0.8)
    both = [[k for k in left if k in top] for left, top in zip(expected, clusters_at(on_top), strict=True)]
    assert clusters_at(remove_supports(on_top, supported, instance_ids, seen, stride)) == both
    unchanged = remove_supports(points, supported & False, instance_ids, seen, stride)
    assert clusters_at(unchanged) == clusters_at(points), "expected unchanged input lists"
