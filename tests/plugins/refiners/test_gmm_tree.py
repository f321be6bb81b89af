"""Tests for refiner=gmm_tree, with a box on a floor in front of a wall under a bleeding mask."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import ConfigError
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from plugins.refiners.gmm_tree import GmmTree
from plugins.refiners.identity import Identity
from tests.support.thread_counts import by_one_thread_and_two

CAMERA = Camera(320, 240, 270.0, 270.0, 159.5, 119.5)


def room() -> tuple[np.ndarray, np.ndarray]:
    """Return noisy depth (H, W), m, and ids (H, W).

    The front (1) and the top (2) of the box are at 2 m. The floor and the wall at 3 m are 0.
    """
    v, u = np.mgrid[:240, :320]
    ray_x, ray_y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    depth = np.minimum(3.0, 0.8 / np.maximum(ray_y, 1e-9))
    front = (np.abs(2.0 * ray_x) < 0.25) & (2.0 * ray_y > 0.3) & (2.0 * ray_y < 0.8)
    top_z = 0.3 / np.maximum(ray_y, 1e-9)
    top = (top_z > 2.0) & (top_z < 2.5) & (np.abs(top_z * ray_x) < 0.25)
    depth = np.where(front, 2.0, np.where(top, top_z, depth))
    noise = np.random.default_rng(0).normal(0, 0.003, depth.shape) * depth
    return (depth + noise).astype(np.float32), front + 2 * (top & ~front).astype(np.int32)


def frame_of(depth: np.ndarray) -> Frame:
    return Frame(0, 0.0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)


def lifted(masks: np.ndarray, frame: Frame) -> PointClusters:
    n = len(masks)
    ones = np.ones(n, np.float32)
    detections = Detections(masks, np.zeros((n, 4), np.float32), ones, ones[:, None], ("thing",))
    return lift(detections, frame, Pose(exp_se3(np.array([0.3, -0.2, 1.0, 0.2, -0.4, 0.1]))))


def bleeding(mask: np.ndarray, px: int) -> np.ndarray:
    """Return the mask dilated by `px` pixels."""
    v, u = np.nonzero(mask)
    grown = np.zeros_like(mask)
    for dv in range(-px, px + 1):
        for du in range(-px, px + 1):
            grown[np.clip(v + dv, 0, mask.shape[0] - 1), np.clip(u + du, 0, mask.shape[1] - 1)] = True
    return grown


def kept(refined: PointClusters, cluster: int = 0) -> np.ndarray:
    mask = np.zeros(CAMERA.shape, bool)
    pixels = refined.pixels[refined.cluster == cluster]
    mask[pixels[:, 1], pixels[:, 0]] = True
    return mask


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("px", [4, 6, 8])
def test_gmm_tree_removes_mask_bleed(px, levels):
    depth, ids = room()
    frame = frame_of(depth)
    mask = bleeding(ids > 0, px)
    after = kept(GmmTree(levels=levels).refine(lifted(mask[None], frame), frame))
    assert after[ids == 1].mean() > 0.98, (
        "expected the front of the box; its top is ambiguous within the bleeding margin"
    )
    assert 1 - after[mask & (ids == 0)].mean() > 0.92
    before = kept(Identity().refine(lifted(mask[None], frame), frame))
    assert before[mask].all(), "expected background points in the input"


def test_gmm_tree_mask_log_odds_decide_in_one_plane():
    """Object and wall are in one plane, so the points do not distinguish them."""
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    frame = frame_of(depth)
    mask = np.zeros((1, *CAMERA.shape), bool)
    mask[0, 60:180, 100:220] = True
    clusters = lifted(mask, frame)
    after = kept(GmmTree().refine(clusters, frame))
    assert after[85:155, 125:195].mean() > 0.98
    assert len(GmmTree(mask_log_odds=0.0).refine(clusters, frame).pixels) == 0, (
        "expected no points: without evidence, both sides tie"
    )


def test_gmm_tree_refines_masks_independently():
    depth, ids = room()
    frame = frame_of(depth)
    wall = np.zeros_like(ids, bool)
    wall[20:80, 20:80] = True
    masks = np.stack([bleeding(ids > 0, 6), np.zeros_like(wall), wall])
    both = GmmTree().refine(lifted(masks, frame), frame)
    alone = GmmTree().refine(lifted(masks[:1], frame), frame)
    np.testing.assert_array_equal(both.pixels[both.cluster == 0], alone.pixels)
    assert (both.cluster != 1).all()


def test_gmm_tree_cluster_with_too_few_points_is_unchanged():
    depth, ids = room()
    frame = frame_of(depth)
    tiny = np.zeros((1, *CAMERA.shape), bool)
    tiny[0, 100:105, 150:155] = True
    assert len(GmmTree().refine(lifted(tiny, frame), frame).pixels) == 25, (
        "expected no change for fewer than min_points points"
    )
    lonely = frame_of(np.where(ids > 0, depth, 0).astype(np.float32))
    box = lifted((ids > 0)[None], lonely)
    assert len(GmmTree().refine(box, lonely).pixels) == (ids > 0).sum(), "expected no change for a ring without depth"
    sparse = frame_of(np.where((np.indices(depth.shape).sum(axis=0) % 40) == 0, depth, 0).astype(np.float32))
    few = lifted(bleeding(ids > 0, 8)[None], sparse)
    assert len(GmmTree(min_split_points=10**6).refine(few, sparse).pixels) == len(few.pixels), (
        "expected no change for a tree without nodes"
    )


def test_gmm_tree_keeps_unassigned_points():
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(bleeding(ids > 0, 8)[None], frame)
    cluster = before.cluster.copy()
    cluster[::7] = -1
    arrays = (before.points_world, before.pixels, cluster, before.class_probabilities, before.scores, before.classes)
    assert (GmmTree().refine(PointClusters(*arrays), frame).cluster == -1).sum() == (cluster == -1).sum()


def test_gmm_tree_does_not_depend_on_thread_count():
    depth, ids = room()
    frame = frame_of(depth)
    before = lifted(np.stack([bleeding(ids > 0, 8), ids > 0]), frame)
    refiner = GmmTree(levels=3, min_split_points=16)
    np.testing.assert_array_equal(*by_one_thread_and_two(lambda: refiner.refine(before, frame).pixels))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"levels": 0}, r"GmmTree\.levels: expected a value in"),
        ({"children": 1}, r"GmmTree\.children: expected a value in"),
        ({"min_support": 1.0}, "GmmTree.min_support"),
    ],
)
def test_gmm_tree_invalid_parameter_raises(parameters, message):
    with pytest.raises(ConfigError, match=message):
        GmmTree(**parameters)
