"""Tests for the rings around masks, compared with slow references."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numba
import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError
from framework.geometry import back_project
from framework.refinement.lifting import lift
from framework.refinement.neighborhood import Neighborhoods, Ring, members, surroundings, thread_schedule
from framework.refinement.neighborhood_kernels import grouped

CAMERA = Camera(60, 40, 50.0, 52.0, 29.5, 19.5)


def frame_of(depth: np.ndarray) -> Frame:
    return Frame(0, 0.0, np.zeros((40, 60, 3), np.uint8), depth.astype(np.float32), CAMERA)


def clusters_of(masks: np.ndarray, frame: Frame) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    detections = Detections(masks, np.zeros((n, 4), np.float32), ones, ones[:, None], ("thing",))
    return lift(detections, frame, Pose(np.eye(4)))


def neighborhoods(clusters: PointClusters, frame: Frame, *ring: float, **named: float) -> Neighborhoods:
    """Return the neighborhoods with all points of masks and rings."""
    return surroundings(clusters, frame, Ring(*ring, **named)).sampled(10**9)


def random_scene(seed: int) -> tuple[np.ndarray, Frame]:
    """Return five overlapping masks, some at the image border, and a frame with missing depth."""
    rng = np.random.default_rng(seed)
    masks = np.zeros((5, 40, 60), np.uint8)
    for mask in masks:
        center = tuple(int(x) for x in rng.integers((0, 0), (60, 40)))
        cv2.ellipse(mask, center, tuple(int(x) for x in rng.integers(2, 15, 2)), 30, 0, 360, 1, -1)
    depth = rng.uniform(1, 3, (40, 60)) * (rng.random((40, 60)) > 0.2)
    return masks.astype(bool), frame_of(depth)


@pytest.mark.parametrize("make", [np.asarray, np.sort, lambda cluster: cluster[:0]])
def test_neighborhood_grouped_is_stable_sort(make):
    cluster = make(np.random.default_rng(0).integers(-1, 4, 200).astype(np.int32))
    order, firsts = grouped(cluster, 5)
    expected = np.argsort(cluster, kind="stable")[(cluster < 0).sum() :]
    np.testing.assert_array_equal(order, expected)
    np.testing.assert_array_equal(firsts, np.searchsorted(cluster[expected], np.arange(6)))


@pytest.mark.parametrize("make", [np.asarray, np.sort])
def test_neighborhood_members_of_sorted_clusters_is_slice(make):
    masks, frame = random_scene(0)
    whole = clusters_of(masks, frame)
    cluster = make(np.where(np.arange(len(whole.cluster)) % 7 == 0, -1, whole.cluster).astype(np.int32))
    order, firsts = members(replace(whole, cluster=cluster))
    expected, expected_firsts = grouped(cluster, len(whole))
    assert isinstance(order, slice) == (make is np.sort)
    np.testing.assert_array_equal(np.arange(len(cluster))[order], expected)
    np.testing.assert_array_equal(firsts, expected_firsts)


def test_neighborhood_thread_schedule_balances_costs():
    threads = numba.get_num_threads()
    for costs in ([5, 1, 9, 4, 3, 2], [7], [0, 0, 0], []):
        order, starts = thread_schedule(np.array(costs, np.int64))
        assert sorted(order) == list(range(len(costs)))
        assert len(starts) == threads + 1
        assert (starts[0], starts[-1]) == (0, len(costs))
        loads = [sum(costs[k] for k in order[a:b]) for a, b in pairwise(starts)]
        assert max(loads) <= sum(costs) / threads + max(costs, default=0), "expected a load within Graham's bound"


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_depth_in_mask_equals_chamfer_distance(fraction: float):
    """The distance in a cluster is to the nearest outer pixel with depth. In the ring, it is to the cluster.

    Structure is treated like missing depth, except in the cluster itself.
    """
    for seed in range(5):
        masks, frame = random_scene(seed)
        structure = np.random.default_rng(1).random((40, 60)) < fraction
        clusters = replace(clusters_of(masks, frame), structure=structure)
        around = neighborhoods(clusters, frame, ring_fraction=0.25, min_ring=6, max_ring=8)
        for k in range(5):
            own, seen = masks[k] & (frame.depth > 0), (frame.depth > 0) & ~structure
            outside, inside = _chamfer_reference(own), _chamfer_reference(~own & seen)
            ring = ~own & seen & (outside <= 3 * around.ring_widths[k])
            expected = np.concatenate([inside[own], -outside[ring]]) / 3
            part = slice(around.starts[k], around.starts[k + 1])
            np.testing.assert_allclose(around.depth_in_mask[part], expected, rtol=1e-6)
            assert around.mask_radii[k] == around.depth_in_mask[part].max(initial=0)
            assert (around.points_camera[part, 2] > 0).all()
        assert (structure & masks.any(axis=0) & (frame.depth > 0)).any() == (fraction > 0)


def test_neighborhood_without_ring_has_only_mask_points():
    masks, frame = random_scene(0)
    clusters = clusters_of(masks, frame)
    around = neighborhoods(clusters, frame, ring_fraction=0.0, min_ring=6, max_ring=8)
    with_ring = neighborhoods(clusters, frame, ring_fraction=0.25, min_ring=6, max_ring=8)
    assert not around.of_ring.any()
    assert not around.ring_widths.any()
    np.testing.assert_array_equal(around.points_camera, with_ring.points_camera[~with_ring.of_ring])
    np.testing.assert_array_equal(around.depth_in_mask, with_ring.depth_in_mask[~with_ring.of_ring])


def test_neighborhood_matches_back_projection_and_distances():
    for seed in range(5):
        masks, frame = random_scene(seed)
        clusters = clusters_of(masks, frame)
        around = neighborhoods(clusters, frame, ring_fraction=0.25, min_ring=3, max_ring=5)
        for k in range(5):
            own = masks[k] & (frame.depth > 0)
            width = int(np.clip(np.rint(0.25 * np.sqrt(own.sum())), 3, 5))
            assert around.ring_widths[k] == width
            # the chessboard distance is at most a third of the 3-4 chamfer distance
            steps = cv2.distanceTransform((~own).astype(np.uint8), cv2.DIST_C, 3)
            ring = ~own & (frame.depth > 0) & (_chamfer_reference(own) <= 3 * width)
            assert (steps[ring] <= width).all()
            s = slice(around.starts[k], around.starts[k + 1])
            pixels = np.concatenate([np.argwhere(own), np.argwhere(ring)])[:, ::-1].astype(np.int32)
            expected = back_project(CAMERA, pixels, frame.depth[pixels[:, 1], pixels[:, 0]])
            np.testing.assert_array_equal(around.points_camera[s], expected)
            assert around.mask_counts[k] == own.sum()
            assert around.ring_counts[k] == ring.sum()
            np.testing.assert_array_equal(around.of_ring[s], np.arange(len(pixels)) >= own.sum())


def _chamfer_reference(mask: np.ndarray) -> np.ndarray:
    """Return the 3-4 chamfer distance (H, W) from a mask, in thirds of a pixel."""
    distance = np.where(mask, 0, 10**6)
    while True:
        padded = np.pad(distance, 1, constant_values=10**6)
        shifted = [
            padded[1 + dv : 41 + dv, 1 + du : 61 + du] + (3 if 0 in (dv, du) else 4)
            for dv in (-1, 0, 1)
            for du in (-1, 0, 1)
            if (dv, du) != (0, 0)
        ]
        relaxed = np.minimum(distance, np.min(shifted, axis=0))
        if (relaxed == distance).all():
            return distance
        distance = relaxed


def test_depth_in_mask_ignores_pixels_without_depth():
    mask = np.zeros((1, 40, 60), bool)
    mask[0, 10:31, 20:41] = True
    depth = np.ones((40, 60))
    depth[20, 30] = 0  # a hole in the mask is not a border
    frame = frame_of(depth)
    around = neighborhoods(clusters_of(mask, frame), frame, 0.25, 4, 12)
    inside = np.zeros((40, 60))
    inside[np.nonzero(mask[0] & (depth > 0))] = around.depth_in_mask[: around.mask_counts[0]]
    assert inside[20, 29] == 10.0
    assert inside[10, 30] == 1.0
    assert around.depth_in_mask.min() == -around.ring_widths[0]


def test_neighborhood_sampled_keeps_every_nth_point():
    masks, frame = random_scene(1)
    around = neighborhoods(clusters_of(masks, frame), frame, 0.25, 4, 12)
    thin = surroundings(clusters_of(masks, frame), frame, Ring()).sampled(50)
    counts = np.diff(around.starts)
    for k, step in enumerate(np.maximum(-(-counts // 50), 1)):
        own = slice(around.starts[k], around.starts[k + 1])
        np.testing.assert_array_equal(
            thin.points_camera[thin.starts[k] : thin.starts[k + 1]], around.points_camera[own][::step]
        )
        is_mask = ~around.of_ring[own][::step]
        assert is_mask.sum() == thin.mask_counts[k]


def test_neighborhood_without_clusters_or_depth_is_empty():
    frame = frame_of(np.zeros((40, 60)))
    around = neighborhoods(clusters_of(np.zeros((0, 40, 60), bool), frame), frame, 0.25, 4, 12)
    assert len(around) == 0
    around = neighborhoods(clusters_of(np.ones((2, 40, 60), bool), frame), frame, 0.25, 4, 12)
    assert around.mask_counts.tolist() == around.ring_counts.tolist() == [0, 0]


def test_neighborhood_ring_out_of_range_raises() -> None:
    with pytest.raises(ConfigError, match=r"Ring\.max_ring: expected a value in \[20, 80\], got 12"):
        Ring(min_ring=20)
