"""Tests for refiner=geometric, with a box on a table under small, bleeding and overlapping masks."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from plugins.refiners.geometric import Geometric
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(320, 240, 180.0, 180.0, 159.5, 119.5)
POSE = Pose(exp_se3(np.array([0.3, -0.2, 1.0, 0.2, -0.4, 0.1])))


def table() -> tuple[np.ndarray, np.ndarray]:
    """Return depth (H, W), m, and ids (H, W). The box is 1; the table and the wall at 2 m are 0."""
    v, u = np.mgrid[:240, :320]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    depth = np.minimum(2.0, 0.7 / np.maximum(y, 1e-9))
    front = (np.abs(1.2 * x) < 0.3) & (1.2 * y > 0.42) & (1.2 * y < 0.7)
    top_z = 0.42 / np.maximum(y, 1e-9)
    top = (top_z > 1.2) & (top_z < 1.6) & (np.abs(top_z * x) < 0.3)
    return np.where(front, 1.2, np.where(top, top_z, depth)).astype(np.float32), (front | top).astype(np.int32)


def frame_of(depth: np.ndarray) -> Frame:
    return Frame(3, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), CAMERA)


def lifted(masks: np.ndarray, frame: Frame) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    detections = Detections(
        masks, np.zeros((n, 4), np.float32), ones, np.tile(np.float32([0.3, 0.7]), (n, 1)), ("a", "b")
    )
    return lift(detections, frame, POSE)


def image_of(clusters: PointClusters, k: int) -> np.ndarray:
    image = np.zeros(CAMERA.shape, bool)
    u, v = clusters.pixels[clusters.cluster == k].T
    assert not image[v, u].any()
    image[v, u] = True
    assert image.sum() == (clusters.cluster == k).sum(), "expected each pixel once"
    return image


def shifted(mask: np.ndarray, dv: int, du: int) -> np.ndarray:
    moved = np.zeros_like(mask)
    v, u = np.nonzero(mask)
    inside = (v + dv >= 0) & (v + dv < mask.shape[0]) & (u + du >= 0) & (u + du < mask.shape[1])
    moved[v[inside] + dv, u[inside] + du] = True
    return moved


def test_geometric_corrects_shifted_mask_to_box():
    """The mask is shifted to the right by 8 px, so it includes the table and lacks a part of the box."""
    depth, ids = table()
    frame = frame_of(depth)
    mask = shifted(ids == 1, 0, 8)
    before = lifted(mask[None], frame)
    after = Geometric().refine(before, frame)
    box = image_of(after, 0)
    assert (box & (ids == 1)).sum() > 0.97 * (ids == 1).sum()
    assert (box & (ids == 0)).sum() < 2 * 90, "expected table pixels only along the border"
    assert (box & ~mask).sum() > 200, "expected added pixels of the box"
    everything = lifted(np.ones((1, *CAMERA.shape), bool), frame).points_world.reshape(*CAMERA.shape, 3)
    u, v = after.pixels.T
    np.testing.assert_allclose(after.points_world, everything[v, u], atol=1e-5)
    assert after.points_world.dtype == np.float32
    np.testing.assert_array_equal(after.scores, before.scores)
    np.testing.assert_array_equal(after.class_probabilities, before.class_probabilities)


def test_geometric_without_growth_only_shrinks():
    depth, ids = table()
    frame = frame_of(depth)
    mask = shifted(ids == 1, 0, 8)
    grown = image_of(Geometric().refine(lifted(mask[None], frame), frame), 0)
    shrunk = image_of(Geometric(grow_to_segments=False).refine(lifted(mask[None], frame), frame), 0)
    np.testing.assert_array_equal(shrunk, grown & mask)


def test_geometric_segment_is_assigned_to_best_covering_mask():
    depth, ids = table()
    frame = frame_of(depth)
    u = np.arange(320)[None]
    more, less = (ids == 1) & (u < 168), (ids == 1) & (u >= 160)  # overlapping masks that cover 59 and 50 % of the box
    refined = Geometric(min_overlap=0.5).refine(lifted(np.stack([less, more, np.zeros_like(more)]), frame), frame)
    assert len(refined) == 3
    assert set(refined.cluster.tolist()) == {1}
    assert image_of(refined, 1)[ids == 1].mean() > 0.97
    equal = Geometric().refine(lifted(np.stack([ids == 1, ids == 1]), frame), frame)
    assert set(equal.cluster.tolist()) == {0}, "expected the first of equal masks"


@pytest.mark.parametrize(("min_overlap", "claimed"), [(0.4, True), (0.6, False)])
def test_geometric_segment_below_min_overlap_is_not_assigned(min_overlap, claimed):
    depth, ids = table()
    frame = frame_of(depth)
    half = (ids == 1) & (np.arange(320)[None] < 160)
    refined = Geometric(min_overlap=min_overlap).refine(lifted(half[None], frame), frame)
    assert (len(refined.cluster) > 0) == claimed
    assert len(refined) == 1


def test_geometric_keeps_unassigned_points():
    depth, ids = table()
    frame = frame_of(depth)
    before = lifted((ids == 1)[None], frame)
    cluster = before.cluster.copy()
    cluster[::7] = -1
    arrays = (before.points_world, before.pixels, cluster, before.class_probabilities, before.scores, before.classes)
    after = Geometric().refine(PointClusters(*arrays), frame)
    np.testing.assert_array_equal(after.pixels[after.cluster == -1], before.pixels[::7])


def test_geometric_collinear_points_are_not_extended():
    """A mask of one column has collinear points, which do not determine the camera pose."""
    depth = np.zeros(CAMERA.shape, np.float32)
    depth[40:80, 60:62] = 1.0
    frame = frame_of(depth)
    mask = np.zeros((1, *CAMERA.shape), bool)
    mask[0, 40:80, 60] = True
    refiner = Geometric(cell_size=1, min_segment=10, min_overlap=0.3)
    before = lifted(mask, frame)
    np.testing.assert_array_equal(refiner.refine(before, frame).pixels, before.pixels)
    mask[0, 40:80, 61] = True
    mask[0, 70:80, 61] = False
    assert len(refiner.refine(lifted(mask, frame), frame).pixels) == 80, (
        "expected added points: two columns determine the pose"
    )


def test_geometric_degenerate_input_is_valid():
    refiner = Geometric()
    depth, _ = table()
    nothing = lifted(np.zeros((0, *CAMERA.shape), bool), frame_of(depth))
    assert len(refiner.refine(nothing, frame_of(depth))) == 0
    blind = frame_of(np.zeros_like(depth))
    empty = refiner.refine(lifted(np.ones((2, *CAMERA.shape), bool), blind), blind)
    assert (len(empty), len(empty.points_world)) == (2, 0)
    one = np.zeros((1, *CAMERA.shape), bool)
    one[0, 60, 80] = True
    assert len(refiner.refine(lifted(one, frame_of(depth)), frame_of(depth)).points_world) <= 1


def test_geometric_does_not_depend_on_thread_count():
    depth, ids = table()
    noise = np.random.default_rng(0).normal(0, 0.003, depth.shape)
    frame = frame_of(depth + noise)
    before = lifted(np.stack([shifted(ids == 1, 0, 8), ids == 0]), frame)
    one, two = by_one_thread_and_two(lambda: Geometric().refine(before, frame))
    np.testing.assert_array_equal(one.pixels, two.pixels)
    np.testing.assert_array_equal(one.points_world, two.points_world)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"cell_size": 0}, r"Geometric\.cell_size: expected a value in"),
        ({"noise_factor": float("nan")}, "noise_factor: .* got nan"),
        ({"max_angle": 90.0}, "Geometric.max_angle"),
        ({"min_overlap": 1.0}, "Geometric.min_overlap"),
    ],
)
def test_geometric_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        Geometric(**parameters)
