"""Tests for sparse tracking, in a textured room with known poses and on real video."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from framework.data import Frame, Pose
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError
from framework.evaluation.trajectory import evaluate
from framework.geometry import exp_se3, inverse, rotation_angle
from plugins.trackers.pycolmap_pnp import PycolmapPnp
from tests.support.scenes.corner_room import GridMap
from tests.support.scenes.papered_room import CAMERA, papered_frame

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
SCENE = GridMap()
BLACK = np.zeros((*CAMERA.shape, 3), np.uint8)


def pose_at(k: int) -> np.ndarray:
    """Return the pose of a frame. The motion is about 2 cm and 2 degrees per frame."""
    return exp_se3(np.array([0.02, -0.005, 0.01, 0.003, 0.035, 0.002]) * k)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [papered_frame(pose_at(k), k) for k in range(16)]


def track(frames: list[Frame], **parameters: int) -> list[Pose]:
    tracker = PycolmapPnp(**parameters)
    return [tracker.track(frame, SCENE) for frame in frames]


def assert_near(pose: Pose, frame: Frame) -> None:
    assert frame.T_world_camera is not None
    error = inverse(frame.T_world_camera) @ pose.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert rotation_angle(error[:3, :3]) < 0.005


def test_pycolmap_pnp_recovers_known_motion_repeatably(frames: list[Frame]) -> None:
    poses = track(frames)
    assert not any(pose.lost for pose in poses)
    for pose, frame in zip(poses, frames, strict=True):
        assert_near(pose, frame)
    for pose, again in zip(poses, track(frames), strict=True):
        np.testing.assert_array_equal(pose.T_world_camera, again.T_world_camera)


def test_pycolmap_pnp_relocalizes_after_uninformative_frames(frames: list[Frame]) -> None:
    rng = np.random.default_rng(0)
    garbage = replace(
        frames[4],
        color=rng.integers(0, 255, BLACK.shape).astype(np.uint8),
        depth=rng.uniform(0.5, 4, CAMERA.shape).astype(np.float32),
    )
    black = replace(frames[5], color=BLACK)
    blind = replace(black, depth=np.zeros(CAMERA.shape, np.float32))
    onwards = [papered_frame(pose_at(k), k) for k in range(4, 68, 4)]
    elsewhere = papered_frame(pose_at(0), paper=1)
    poses = track([frames[0], *onwards, garbage, black, blind, elsewhere, frames[1]])
    assert [pose.lost for pose in poses] == [False] * 17 + [True] * 4 + [False]
    assert "too few of the frame's" in poses[17].reason
    np.testing.assert_array_equal(poses[20].T_world_camera, poses[16].T_world_camera)
    assert_near(poses[-1], frames[1])  # a view that is not in the keyframes near the last pose


def test_pycolmap_pnp_depth_inconsistent_with_color_is_lost(frames: list[Frame]) -> None:
    assert track([*frames[:2], replace(frames[2], depth=1.3 * frames[2].depth)])[-1].lost
    without = track([*frames[:2], replace(frames[2], depth=np.zeros(CAMERA.shape, np.float32))])[-1]
    assert not without.lost, "expected a pose from pixels alone"
    assert_near(without, frames[2])


def test_pycolmap_pnp_black_video_starts_at_first_features(frames: list[Frame]) -> None:
    poses = track([replace(frames[0], color=BLACK), *frames[1:3]])
    assert [pose.lost for pose in poses] == [True, False, False]
    assert poses[0].reason == "the frame has fewer than 30 features with depth"
    assert_near(poses[-1], frames[2])


def test_pycolmap_pnp_invalid_parameter_raises() -> None:
    for bound in ({"min_inliers": 3}, {"max_ratio": 0.0}, {"candidates": 0}, {"max_error": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(bound))):
            PycolmapPnp(**bound)


@pytest.mark.skipif(not SHARED.is_dir(), reason="requires ../shared/data")
def test_pycolmap_pnp_tracks_real_video() -> None:
    kitchen = list(RgbdFolder(SHARED / "redkitchen", stop=60, stride=3))
    poses = track(kitchen)
    assert not any(pose.lost for pose in poses)
    assert evaluate([frame.T_world_camera for frame in kitchen], poses).ate_rmse_m < 0.03
