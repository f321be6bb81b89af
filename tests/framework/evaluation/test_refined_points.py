"""Tests for the evaluation of refiners, compared with manual results."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, FrameTruth, PointClusters
from framework.evaluation.refined_points import Refinement, true_fit
from framework.interfaces import ClusterRefiner
from tests.support.scenes.corner_room import CornerRoom, SphereDetector

SIZE = 10  # px


def frame(instance_ids: np.ndarray | None = None, names: dict[int, str | None] | None = None) -> Frame:
    """Return a frame of a wall 2 m away. Without `names`, every instance is a chair."""
    truth = None
    if instance_ids is not None:
        truth = FrameTruth(instance_ids, names or {int(i): "chair" for i in np.unique(instance_ids) if i})
    depth = np.full((SIZE, SIZE), 2.0, np.float32)
    color = np.full((SIZE, SIZE, 3), 100, np.uint8)
    return Frame(0, 0.0, color, depth, Camera(SIZE, SIZE, 10.0, 10.0, 4.5, 4.5), truth=truth)


def clusters(*masks: np.ndarray) -> PointClusters:
    """Return a cluster for each mask (SIZE, SIZE)."""
    places = [np.argwhere(mask)[:, ::-1] for mask in masks]
    pixels = np.concatenate([np.zeros((0, 2), np.int64), *places]).astype(np.int32)
    n = len(masks)
    return PointClusters(
        points_world=np.zeros((len(pixels), 3), np.float32),
        pixels=pixels,
        cluster=np.repeat(np.arange(n), [len(place) for place in places]).astype(np.int32),
        class_probabilities=np.ones((n, 1), np.float32),
        scores=np.ones(n, np.float32),
        classes=("chair",),
    )


def rows(first: int, last: int) -> np.ndarray:
    """Return a mask (SIZE, SIZE) of the rows in [first, last)."""
    mask = np.zeros((SIZE, SIZE), np.bool_)
    mask[first:last] = True
    return mask


def ids(*objects: np.ndarray) -> np.ndarray:
    image = np.zeros((SIZE, SIZE), np.int32)
    for k, mask in enumerate(objects, start=1):
        image[mask] = 10 * k
    return image


def test_true_fit_uses_object_with_best_iou() -> None:
    # rows 2 to 7 cover half of the first object and all of the second one: IoU 20/80 and 40/60
    seen = frame(ids(rows(0, 4), rows(4, 8)))
    fit = true_fit(clusters(rows(2, 8), rows(9, 10), rows(0, 0)), seen, seen.truth)  # type: ignore[arg-type]
    np.testing.assert_allclose(fit.iou, [40 / 60, 0, 0])
    np.testing.assert_array_equal(fit.points_inside, [40, 0, 0])
    assert not fit.unknown.any()


def test_true_fit_ignores_pixels_without_depth() -> None:
    seen = frame(ids(rows(0, 4)))
    seen.depth[:2] = 0
    fit = true_fit(clusters(rows(2, 4)), seen, seen.truth)  # type: ignore[arg-type]
    np.testing.assert_array_equal(fit.iou, [1.0])


def test_refinement_excludes_clusters_of_unknown_class() -> None:
    seen = frame(ids(rows(0, 4), rows(4, 8)), {10: None, 20: "chair"})
    before = clusters(rows(0, 5), rows(3, 8))
    refined = Refinement(seen, before, clusters(rows(4, 5), rows(4, 8)), 1.0)
    assert refined.fit_before is not None
    np.testing.assert_array_equal(refined.fit_before.unknown, [True, False])
    np.testing.assert_allclose(refined.fit_before.iou, [10 / 80, 40 / 50])  # IoU with the chair
    np.testing.assert_array_equal(refined.judged_before, [False, True])
    # the first refined cluster is not evaluated, although it is on the chair
    np.testing.assert_array_equal(refined.judged_after, [False, True])


def test_refinement_without_truth_is_not_evaluated() -> None:
    blind = Refinement(frame(), clusters(rows(0, 3)), clusters(rows(0, 2)), 1.0)
    assert blind.fit_before is None
    assert blind.fit_after is None
    assert not blind.judged_before.any()
    assert not blind.judged_after.any()
    empty = frame(np.zeros((SIZE, SIZE), np.int32))
    fit = true_fit(clusters(rows(0, 3)), empty, empty.truth)  # type: ignore[arg-type]
    np.testing.assert_array_equal(fit.iou, [0.0])


def test_refinement_equal_cluster_count_keeps_indices() -> None:
    refined = Refinement(frame(), clusters(rows(0, 5), rows(5, 9)), clusters(rows(5, 9), rows(0, 0)), 1.0)
    np.testing.assert_array_equal(refined.origin, [0, 1])
    np.testing.assert_array_equal(refined.points_before, [50, 40])
    np.testing.assert_array_equal(refined.points_after, [40, 0])


def test_refinement_assigns_parts_by_largest_overlap() -> None:
    before = clusters(rows(0, 6), rows(6, 9), rows(1, 1))
    after = clusters(rows(0, 2), rows(2, 6), rows(9, 10), rows(5, 9))
    refined = Refinement(frame(), before, after, 1.0)
    np.testing.assert_array_equal(refined.origin, [0, 0, -1, 1])
    np.testing.assert_array_equal(refined.main_part, [1, 3, -1])
    np.testing.assert_array_equal(refined.points_after, [60, 40, 0])
    from_nothing = Refinement(frame(), clusters(), after, 1.0)
    np.testing.assert_array_equal(from_nothing.origin, [-1] * 4)
    to_nothing = Refinement(frame(), before, clusters(), 1.0)
    np.testing.assert_array_equal(to_nothing.points_after, [0, 0, 0])


@dataclass
class Counting(ClusterRefiner):
    """Refiner that removes every second point and counts its calls."""

    def __post_init__(self) -> None:
        self.calls = 0

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        self.calls += 1
        return replace(
            clusters,
            points_world=clusters.points_world[::2],
            pixels=clusters.pixels[::2],
            cluster=clusters.cluster[::2],
        )


@pytest.mark.parametrize("truth", [True, False])
def test_refinement_measures_refiner_on_lifted_detections(truth: bool) -> None:
    seen = CornerRoom()[2]
    found: Detections = SphereDetector().detect(seen)
    if not truth:
        seen = replace(seen, truth=None, T_world_camera=None)
    refiner = Counting()
    refined = Refinement.of(refiner, found, seen)
    assert refiner.calls > 1
    assert refined.milliseconds > 0
    assert len(Refinement.of(refiner, replace(found, exact=True), seen).after.cluster) == found.masks.sum()
    np.testing.assert_array_equal(refined.points_before, found.masks.sum(axis=(1, 2)))
    assert len(refined.after.cluster) == -(-len(refined.before.cluster) // 2)
    depth = refined.before.points_world[:, 2]
    read = seen.depth[refined.before.pixels[:, 1], refined.before.pixels[:, 0]]
    assert np.array_equal(depth, read) is not truth  # without a pose, the points are in the camera frame
