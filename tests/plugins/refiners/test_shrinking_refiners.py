"""Tests for refiners that only remove points, with a box on a floor under a bleeding mask."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError
from framework.geometry import back_project, exp_se3
from framework.interfaces import ClusterRefiner
from framework.refinement.lifting import lift
from framework.refinement.neighborhood import Ring
from plugins.refiners.connected import Connected
from plugins.refiners.gmm_em import GmmEm
from plugins.refiners.gmm_tree import GmmTree
from plugins.refiners.identity import Identity
from plugins.refiners.kmeans import KMeans
from plugins.refiners.largest_component import LargestComponent
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)
REFINERS: list[Callable[[], ClusterRefiner]] = [Identity, GmmEm, KMeans, LargestComponent, Connected]
T_WORLD_CAMERA = exp_se3(np.array([0.3, -0.2, 1.0, 0.2, -0.4, 0.1]))


def room(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy depth (H, W), m, and ids (H, W).

    The wall at 3 m and the floor are 0, the box is 1, and the pole is 2. The front of the box is at 2 m, and the pole
    at 1.2 m occludes its left edge.
    """
    v, u = np.mgrid[:240, :320]
    ray_x, ray_y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    with np.errstate(divide="ignore"):
        floor = np.where(ray_y > 0, 0.8 / ray_y, np.inf)
    depth = np.minimum(3.0, floor)
    ids = np.zeros(depth.shape, np.int32)
    front = (np.abs(2.0 * ray_x) < 0.25) & (2.0 * ray_y > 0.3) & (2.0 * ray_y < 0.8)
    top_z = 0.3 / np.maximum(ray_y, 1e-9)
    top = (top_z > 2.0) & (top_z < 2.5) & (np.abs(top_z * ray_x) < 0.25)
    depth, ids = np.where(front, 2.0, depth), np.where(front, 1, ids)
    depth, ids = np.where(top, top_z, depth), np.where(top, 1, ids)
    pole = (np.abs(1.2 * ray_x + 0.16) < 0.02) & (1.2 * ray_y > -0.1)
    depth, ids = np.where(pole, 1.2, depth), np.where(pole, 2, ids)
    noise = np.random.default_rng(seed).normal(0, 0.003, depth.shape) * depth
    return (depth + noise).astype(np.float32), ids.astype(np.int32)


def frame_of(depth: np.ndarray, camera: Camera = CAMERA) -> Frame:
    return Frame(0, 0.0, np.zeros((*camera.shape, 3), np.uint8), depth, camera)


def lifted(masks: np.ndarray, frame: Frame) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    detections = Detections(
        masks, np.zeros((n, 4), np.float32), ones, np.tile(np.float32([0.25, 0.75]), (n, 1)), ("a", "b")
    )
    return lift(detections, frame, Pose(T_WORLD_CAMERA))


def bleeding(mask: np.ndarray, px: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), np.uint8)).astype(bool)


def recall_and_rejection(refined: PointClusters, before: PointClusters, ids: np.ndarray) -> tuple[float, float]:
    """Return the kept fraction of the box and the removed fraction of the other points of cluster 0."""
    right, was_right = (ids[c.pixels[c.cluster == 0, 1], c.pixels[c.cluster == 0, 0]] == 1 for c in (refined, before))
    return right.sum() / was_right.sum(), 1 - (~right).sum() / (~was_right).sum()


@pytest.mark.parametrize("px", [4, 6, 8])
def test_gmm_em_removes_mask_bleed(px):
    """The removed points are on the pole, the floor and the wall. Two faces of the box are kept."""
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(bleeding(ids == 1, px)[None], frame)
    recall, rejection = recall_and_rejection(GmmEm().refine(before, frame), before, ids)
    assert recall > 0.97
    assert rejection > (0.95 if px < 6 else 0.88)  # `expected_bleed` is 4.8 px
    doubting = GmmEm(object_components=2, mask_log_odds=2.0, expected_bleed=0.5).refine(before, frame)
    doubting_recall, doubting_rejection = recall_and_rejection(doubting, before, ids)
    assert doubting_recall > 0.97
    assert doubting_rejection > 0.95, "expected more removed points for a less trusted mask"
    for other in (KMeans(), LargestComponent(), GmmEm(mask_log_odds=0.0)):
        other_recall, other_rejection = recall_and_rejection(other.refine(before, frame), before, ids)
        assert recall + rejection > other_recall + other_rejection, other


@pytest.mark.parametrize("make", REFINERS)
def test_shrinking_refiner_points_are_subset_of_input(make):
    depth, ids = room()
    depth[100:110, 150:160] = 0
    frame = frame_of(depth)
    masks = np.stack([bleeding(ids == 1, 8), np.zeros_like(ids, bool), bleeding(ids == 2, 3), ids == 1])
    before = lifted(masks, frame)
    after = make().refine(before, frame)
    assert len(after) == len(before) == 4
    np.testing.assert_array_equal(after.scores, before.scores)
    np.testing.assert_array_equal(after.class_probabilities, before.class_probabilities)
    assert after.classes == before.classes
    known = {
        (int(k), *pixel): tuple(point)
        for k, pixel, point in zip(before.cluster, before.pixels.tolist(), before.points_world.tolist(), strict=True)
    }
    for k, pixel, point in zip(after.cluster, after.pixels.tolist(), after.points_world.tolist(), strict=True):
        assert known[(int(k), *pixel)] == tuple(point)
    assert set(np.unique(after.cluster)) == {0, 2, 3}


@pytest.mark.parametrize("make", REFINERS)
def test_shrinking_refiner_does_not_depend_on_cluster_order(make):
    depth, ids = room()
    frame = frame_of(depth)
    masks = np.stack([bleeding(ids == 1, 8), bleeding(ids == 2, 3)])
    both, first = lifted(masks, frame), lifted(masks[:1], frame)
    refined = make().refine(both, frame)
    alone = make().refine(first, frame)
    np.testing.assert_array_equal(refined.pixels[refined.cluster == 0], alone.pixels)
    swapped = make().refine(lifted(masks[::-1], frame), frame)
    np.testing.assert_array_equal(swapped.pixels[swapped.cluster == 1], alone.pixels)


@pytest.mark.parametrize("make", REFINERS)
def test_shrinking_refiner_does_not_depend_on_thread_count(make):
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(np.stack([bleeding(ids == 1, 8), bleeding(ids == 2, 3)]), frame)
    np.testing.assert_array_equal(*by_one_thread_and_two(lambda: make().refine(before, frame).pixels))


@pytest.mark.parametrize("make", REFINERS)
def test_shrinking_refiner_degenerate_input_is_valid(make):
    refiner = make()
    depth, ids = room()
    nothing = lifted(np.zeros((0, 240, 320), bool), frame_of(depth))
    assert len(refiner.refine(nothing, frame_of(depth))) == 0
    blind = frame_of(np.zeros_like(depth))
    empty = refiner.refine(lifted(np.ones((2, 240, 320), bool), blind), blind)
    assert (len(empty), len(empty.points_world)) == (2, 0)
    whole = lifted(np.ones((1, 240, 320), bool), frame_of(depth))
    assert len(refiner.refine(whole, frame_of(depth)).points_world) > 0
    flat = frame_of(np.full_like(depth, 2.0))
    on_wall = refiner.refine(lifted((ids == 1)[None], flat), flat)
    assert len(on_wall) == 1, "expected a result for object and background in one plane"


@pytest.mark.parametrize("make", [GmmEm, KMeans])
def test_shrinking_refiner_keeps_cluster_with_too_few_points(make):
    depth, ids = room()
    tiny = np.zeros((1, 240, 320), bool)
    tiny[0, 100:105, 150:155] = True
    frame = frame_of(depth)
    assert len(make().refine(lifted(tiny, frame), frame).pixels) == 25, (
        "expected no change for fewer than min_points points"
    )
    lonely = frame_of(np.where(ids == 1, depth, 0).astype(np.float32))
    box = lifted((ids == 1)[None], lonely)
    assert len(make().refine(box, lonely).pixels) == (ids == 1).sum(), "expected no change for a ring without depth"


def test_shrinking_refiner_keeps_unassigned_points():
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(bleeding(ids == 1, 8)[None], frame)
    cluster = before.cluster.copy()
    cluster[::7] = -1
    unassigned = PointClusters(
        before.points_world, before.pixels, cluster, before.class_probabilities, before.scores, before.classes
    )
    for make in REFINERS:
        assert (make().refine(unassigned, frame).cluster == -1).sum() == (cluster == -1).sum()


def test_largest_component_keeps_larger_of_two_pieces():
    """The pieces are at 1 m and 1.2 m. The maximum gap at 1 m is 0.05 m, or 0.23 m with the larger slope."""
    camera = Camera(40, 20, 50.0, 50.0, 19.5, 9.5)
    depth = np.full((20, 40), 1.0, np.float32)
    depth[:, 25:] = 1.2
    mask = np.ones((1, 20, 40), bool)
    frame = frame_of(depth, camera)
    kept = LargestComponent(max_gap=0.03, gap_per_depth=0.02).refine(lifted(mask, frame), frame)
    assert set(kept.pixels[:, 0].tolist()) == set(range(25))
    assert len(kept.pixels) == 25 * 20
    joined = LargestComponent(max_gap=0.03, gap_per_depth=0.2).refine(lifted(mask, frame), frame)
    assert len(joined.pixels) == 40 * 20


@pytest.mark.parametrize(("reach", "kept"), [(1, 20), (2, 39)])
def test_largest_component_bridges_missing_depth(reach, kept):
    camera = Camera(40, 1, 50.0, 50.0, 19.5, 0.0)
    depth = np.full((1, 40), 1.0, np.float32)
    depth[0, 20] = 0
    frame = frame_of(depth, camera)
    refined = LargestComponent(connection_radius=reach).refine(lifted(np.ones((1, 1, 40), bool), frame), frame)
    assert len(refined.pixels) == kept


def test_largest_component_agrees_with_scipy():
    from scipy.ndimage import label

    rng = np.random.default_rng(0)
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    frame = frame_of(np.ones((48, 64), np.float32), camera)
    for _ in range(10):
        mask = rng.random((48, 64)) < 0.42
        pieces, _ = label(mask, structure=np.ones((3, 3)))
        largest = pieces == 1 + np.bincount(pieces[mask] - 1).argmax()
        refined = LargestComponent(connection_radius=1).refine(lifted(mask[None], frame), frame)
        found = np.zeros_like(mask)
        found[refined.pixels[:, 1], refined.pixels[:, 0]] = True
        np.testing.assert_array_equal(found, largest)


@pytest.mark.parametrize("reach", [1, 2, 3])
@pytest.mark.parametrize("density", [0.05, 0.3, 0.9])
def test_largest_component_matches_reference(reach, density):
    """In the reference graph, points are connected if they are close in the image and in depth."""
    from scipy.sparse.csgraph import connected_components

    camera = Camera(37, 23, 50.0, 50.0, 18.0, 11.0)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        depth = (2 + rng.choice([0.0, 0.05, 0.1, 0.15], (23, 37), p=[0.4, 0.3, 0.2, 0.1])).astype(np.float32)
        frame = frame_of(depth, camera)
        before = lifted(rng.random((1, 23, 37)) < density, frame)
        u, v = before.pixels.T
        z = depth[v, u].astype(np.float64)
        near = np.maximum(np.abs(u - u[:, None]), np.abs(v - v[:, None])) <= reach
        near &= np.abs(z - z[:, None]) < 0.03 + 0.02 * np.minimum(z, z[:, None])
        _, piece = connected_components(near, directed=False)
        largest = np.bincount(piece).argmax()  # pieces are in the order of their first points
        refined = LargestComponent(connection_radius=reach).refine(before, frame)
        np.testing.assert_array_equal(refined.pixels, before.pixels[piece == largest])


@pytest.mark.parametrize(
    ("make", "parameters", "message"),
    [
        (GmmEm, {"object_components": 0}, r"GmmEm\.object_components: expected a value in"),
        (GmmEm, {"std_floor": float("nan")}, "std_floor: .* got nan"),
        (GmmEm, {"min_posterior": 1.0}, "min_posterior"),
        (KMeans, {"background_centers": -1}, "KMeans.background_centers"),
        (LargestComponent, {"connection_radius": 0}, "LargestComponent.connection_radius"),
    ],
)
def test_shrinking_refiner_invalid_parameter_raises(make, parameters, message):
    with pytest.raises(ConfigError, match=message):
        make(**parameters)


def slow_posterior(points: np.ndarray, iterations: int, std_floor: float, outliers: float) -> np.ndarray:
    """Return the posterior (P,) of a Gaussian against a uniform density, by EM in float64."""
    x = points.astype(np.float64)
    density = 1 / np.prod(np.maximum(x.max(axis=0) - x.min(axis=0), 4 * std_floor))
    weight, responsibilities, uniform = 0.0, np.full(len(x), 1 - outliers), outliers
    for k in range(iterations + 1):
        total = responsibilities.sum()
        weight, mean = total / len(x), responsibilities @ x / total
        values, vectors = np.linalg.eigh((x - mean).T * responsibilities @ (x - mean) / total)
        values = np.maximum(values, std_floor**2)
        squares = ((x - mean) @ vectors) ** 2 @ (1 / values)
        own = weight * np.exp(-0.5 * squares) / np.sqrt((2 * np.pi) ** 3 * values.prod())
        responsibilities = own / (own + uniform * density)
        if k < iterations:
            uniform = 1 - responsibilities.mean()
    return responsibilities


def test_gmm_em_single_gaussian_matches_reference():
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(bleeding(ids == 1, 8)[None], frame)
    refiner = GmmEm(
        object_components=1, background_components=0, tolerance=0.0, outlier_fraction=0.1, mask_log_odds=0.0,
        ring=Ring(max_points=10**6),
    )  # fmt: skip
    after = refiner.refine(before, frame)
    cv, cu = before.pixels[:, 1], before.pixels[:, 0]
    points = back_project(CAMERA, before.pixels, depth[cv, cu])
    posterior = slow_posterior(points, refiner.max_iterations, refiner.std_floor, 0.1)
    kept = np.zeros(depth.shape, bool)
    kept[after.pixels[:, 1], after.pixels[:, 0]] = True
    clear = np.abs(posterior - 0.5) > 1e-3
    np.testing.assert_array_equal(kept[cv, cu][clear], posterior[clear] > 0.5)
    assert 0 < len(after.pixels) < len(before.pixels)


@pytest.mark.parametrize(
    "refiner",
    [
        GmmEm(background_components=0, outlier_fraction=0.0),
        KMeans(background_centers=0),
        GmmEm(outlier_fraction=0.0, ring=Ring(ring_fraction=0.0)),
        GmmTree(ring=Ring(ring_fraction=0.0)),
        KMeans(ring=Ring(ring_fraction=0.0)),
    ],
)
def test_gmm_em_without_background_model_keeps_all_points(refiner):
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(bleeding(ids == 1, 8)[None], frame)
    assert len(refiner.refine(before, frame).pixels) == len(before.pixels)
