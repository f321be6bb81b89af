"""Tests for the recovery of the camera pose from lifted points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Camera, Detections, Frame, PointClusters, Pose
from framework.errors import DataError
from framework.geometry import exp_se3
from framework.refinement.lifting import lift
from framework.refinement.segmentation.segment_owners import camera_pose, points_at

CAMERA = Camera(80, 60, 70.0, 72.0, 39.5, 29.5)
T_WORLD_CAMERA = exp_se3(np.array([0.3, -2.0, 1.0, 0.2, -2.4, 0.1]))


def frame_of(depth: np.ndarray) -> Frame:
    return Frame(0, 0.0, np.zeros((60, 80, 3), np.uint8), depth.astype(np.float32), CAMERA)


def lifted(mask: np.ndarray, frame: Frame) -> PointClusters:
    one = np.ones(1, np.float32)
    detections = Detections(mask[None], np.zeros((1, 4), np.float32), one, one[:, None], ("thing",))
    return lift(detections, frame, Pose(T_WORLD_CAMERA))


@pytest.mark.parametrize("flat", [False, True])
def test_camera_pose_is_recovered_from_lifted_points(flat):
    depth = np.full((60, 80), 2.0) if flat else np.random.default_rng(0).uniform(1, 4, (60, 80))
    frame = frame_of(depth)
    mask = np.zeros((60, 80), bool)
    mask[10:20, 30:45] = True
    T_world_camera = camera_pose(lifted(mask, frame), frame)
    assert T_world_camera is not None
    np.testing.assert_allclose(T_world_camera, T_WORLD_CAMERA, atol=1e-5)
    everything = lifted(np.ones_like(mask), frame)
    found = points_at(everything.pixels, frame, T_world_camera)
    assert found.dtype == np.float32
    assert np.abs(found - everything.points_world).max() < 2e-5, (
        "expected small errors even at 1 m from the 150 points used"
    )
    np.testing.assert_allclose(points_at(everything.pixels, frame, T_WORLD_CAMERA), everything.points_world, atol=1e-6)


def test_camera_pose_of_collinear_points_is_none():
    frame = frame_of(np.full((60, 80), 2.0))
    for chosen in ((slice(10, 11), slice(20, 60)), (slice(10, 11), slice(20, 22)), (slice(0, 0), slice(0, 0))):
        mask = np.zeros((60, 80), bool)
        mask[chosen] = True
        assert camera_pose(lifted(mask, frame), frame) is None


def test_camera_pose_points_of_other_frame_raise():
    frame = frame_of(np.random.default_rng(0).uniform(1, 4, (60, 80)))
    clusters = lifted(np.ones((60, 80), bool), frame)
    moved = clusters.points_world.copy()
    moved += np.linspace(0, 0.02, len(moved), dtype=np.float32)[:, None] ** 2 * 50
    with pytest.raises(
        DataError, match=r"frame 0: expected cluster points within .* m of the frame's depth readings, got 0\.0.* m"
    ):
        camera_pose(replace(clusters, points_world=moved), frame)
