"""Tests for ground truth that is fused from frames by voxel voting."""

from collections import Counter, defaultdict

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.ground_truth.scene_truth import LabeledDepth, fuse_scene_truth
from framework.errors import DataError

CAMERA = Camera(6, 5, 10.0, 12.0, 2.5, 2.0)


def view(depth, ids, T=None, camera=CAMERA):
    return LabeledDepth(np.asarray(depth, np.float32), np.asarray(ids, np.int32), camera, np.eye(4) if T is None else T)


def random_views(count, seed, camera=CAMERA):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        T[:3, :3] *= np.linalg.det(T[:3, :3])
        T[:3, 3] = rng.uniform(-0.2, 0.2, 3)
        depth = rng.uniform(0.2, 0.5, camera.shape) * (rng.uniform(size=camera.shape) > 0.2)
        yield view(depth, rng.integers(0, 4, camera.shape), T, camera)


def reference(views, voxel):
    votes = defaultdict(Counter)
    points = defaultdict(list)
    for labeled in views:
        for v in range(labeled.depth.shape[0]):
            for u in range(labeled.depth.shape[1]):
                z = float(labeled.depth[v, u])
                if z > 0:
                    c = labeled.camera
                    p = labeled.T_world_camera @ [(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z, 1]
                    key = tuple(np.floor(p[:3] / voxel).astype(int))
                    votes[key][int(labeled.instance_ids[v, u])] += 1
                    points[key, int(labeled.instance_ids[v, u])].append(p[:3])
    answer = {}
    for key, count in votes.items():
        best = min(count, key=lambda i: (-count[i], i))
        answer[key] = best, np.mean(points[key, best], axis=0)
    return answer


def test_scene_truth_matches_per_pixel_reference():
    voxel = 0.11
    truth = fuse_scene_truth(random_views(30, 3), {1: "chair"}, voxel)
    expected = reference(random_views(30, 3), voxel)
    assert len(truth.points_world) == len(expected)
    # points and keys are in the order in which their voxels are first observed
    for point, instance, (best, mean) in zip(truth.points_world, truth.instance_ids, expected.values(), strict=True):
        assert instance == best
        np.testing.assert_allclose(point, mean, atol=1e-6)


def test_scene_truth_wall_gives_one_point_per_voxel():
    camera = Camera(200, 150, 100.0, 100.0, 99.5, 74.5)
    truth = fuse_scene_truth(
        [view(np.full(camera.shape, 2.0), np.full(camera.shape, 5), camera=camera)], {5: "tv"}, 0.05
    )
    # pixels are 2 cm apart and cover 4.00 x 3.00 m around the optical axis, minus one pixel
    assert len(truth.points_world) == 80 * 60
    np.testing.assert_allclose(truth.points_world[:, 2], 2.0, atol=1e-6)
    assert (truth.instance_ids == 5).all()


def test_scene_truth_majority_tie_uses_smaller_id():
    depth = np.zeros(CAMERA.shape)
    depth[2, 2] = 1.0
    frames = [view(depth, np.full(CAMERA.shape, i)) for i in (3, 2, 3, 2, 9)]
    assert fuse_scene_truth(frames, {}, 1.0).instance_ids.tolist() == [2]
    assert fuse_scene_truth([*frames, frames[0]], {}, 1.0).instance_ids.tolist() == [3]


def test_scene_truth_hash_table_growth_keeps_voxels_unique():
    camera = Camera(160, 120, 10.0, 10.0, 79.5, 59.5)
    truth = fuse_scene_truth(random_views(6, 1, camera), {}, 0.001)
    assert len(truth.points_world) > 80_000
    again = fuse_scene_truth(random_views(6, 1, camera), {}, 0.001)
    np.testing.assert_array_equal(truth.points_world, again.points_world)
    keys = np.floor(truth.points_world.astype(np.float64) / 0.001).astype(int)
    assert len(np.unique(keys, axis=0)) > 0.99 * len(keys)  # rounding can move a mean into the next voxel


def test_scene_truth_empty_depth_gives_no_points():
    assert len(fuse_scene_truth([view(np.zeros(CAMERA.shape), np.ones(CAMERA.shape))], {}, 0.02).points_world) == 0
    assert len(fuse_scene_truth([], {}, 0.02).points_world) == 0


def test_scene_truth_point_outside_grid_raises():
    with pytest.raises(DataError, match=r"expected all points within \d+ m of the world origin"):
        fuse_scene_truth([view(np.full(CAMERA.shape, 3e6), np.ones(CAMERA.shape))], {}, 0.02)
