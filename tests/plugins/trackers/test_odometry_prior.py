"""Tests of tracker=voxel_hashing_icp on frames with odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from framework.data import Float64, Frame, Pose
from framework.geometry import exp_se3, inverse, pose_distance
from framework.interfaces import SubmapChange
from framework.registry import assemble
from framework.testing.corner_room import CAMERA, RoomMap, look
from plugins.trackers.voxel_hashing_icp import VoxelHashingIcp
from tests.support.scenes.analytic_scene import Scene, pose, room, walk
from tests.support.tracked_frames import track_and_fuse

pytestmark = pytest.mark.integration

START = exp_se3(np.array([3.0, -2.0, 1.0, 0.3, -1.2, 0.5]))  # pose of the world frame in the odometry frame
NO_FEATURES = {"finest_scale": 1.0, "relocalize": False}


def with_odometry(frames: Sequence[Frame], poses: Sequence[Float64]) -> list[Frame]:
    """Return the frames with odometry that measures the motions between `poses`."""
    return [replace(frame, T_odom_camera=START @ T) for frame, T in zip(frames, poses, strict=True)]


def tracked(frames: Sequence[Frame], **parameters: object) -> list[Pose]:
    return track_and_fuse(assemble(VoxelHashingIcp, **parameters), frames)


def error(found: Pose, frame: Frame) -> float:
    """Return the larger error of position, m, and rotation, rad."""
    assert frame.T_world_camera is not None
    return pose_distance(frame.T_world_camera, found.T_world_camera)


def covered(frame: Frame) -> Frame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def test_odometry_predicts_large_steps() -> None:
    """The camera turns by 23 degrees between frames, which exceeds `max_rotation`."""
    motion = [pose(0.1 * k, rotvec=(0, 0.4 * k, 0)) for k in range(3)]
    frames = [room().frame(T, k) for k, T in enumerate(motion)]
    without, found = tracked(frames, **NO_FEATURES), tracked(with_odometry(frames, motion), **NO_FEATURES)
    assert any(one.lost for one in without)
    assert not any(one.lost for one in found)
    assert max(map(error, found, frames)) < 0.01, "expected less than half a voxel"


def test_odometry_predicts_large_step_in_corrected_map() -> None:
    motion = [pose(0.0), pose(0.01), pose(0.02), pose(0.1, rotvec=(0, -0.6, 0))]
    tracker, change = VoxelHashingIcp(**NO_FEATURES), SubmapChange({0: START}, submap=1)
    T_world_room = np.eye(4)
    for k, T_room_camera in enumerate(motion):
        depth, _, color, _ = look(CAMERA, T_room_camera)
        frame = Frame(k, k / 30, color, depth, CAMERA, T_room_camera if k == 0 else None, T_odom_camera=T_room_camera)
        found = tracker.track(frame, RoomMap(T_world_room=T_world_room))
        assert not found.lost, found.reason
        assert pose_distance(T_world_room @ T_room_camera, found.T_world_camera) < 0.01
        if k == 2:
            tracker.correct(change)
            T_world_room = START


@pytest.mark.parametrize("relocalize", [False, True])
def test_odometry_jump_does_not_lose_camera(relocalize: bool) -> None:
    """The origin of odometry changes by 5 m between frames 10 and 11."""
    motion = walk(20)
    frames = [room().frame(T, k) for k, T in enumerate(motion)]
    jumped = [T if k < 11 else pose(5.0) @ T for k, T in enumerate(motion)]
    found = tracked(with_odometry(frames, jumped), finest_scale=1.0, relocalize=relocalize)
    assert not any(one.lost for one in found)
    assert max(map(error, found, frames)) < 0.004


def test_odometry_noise_does_not_change_accuracy() -> None:
    """The noise of each motion is 20 % of the motion."""
    rng = np.random.default_rng(0)
    motion = walk(40)
    noisy = [motion[0]]
    for before, after in pairwise(motion):
        step = inverse(before) @ after
        xi = np.r_[[np.linalg.norm(step[:3, 3])] * 3, [np.arccos((np.trace(step[:3, :3]) - 1) / 2)] * 3]
        noisy.append(noisy[-1] @ step @ exp_se3(0.2 * xi * rng.normal(size=6)))
    frames = [room().frame(T, k) for k, T in enumerate(motion)]
    assert pose_distance(noisy[-1], motion[-1]) > 0.01, "expected odometry with drift"
    found = tracked(with_odometry(frames, noisy), finest_scale=1.0)
    assert not any(one.lost for one in found)
    assert max(map(error, found, frames)) < 0.004


def wall(motion: Sequence[Float64]) -> list[Frame]:
    """Return frames of a blank wall at 1.5 m, with depth noise of 1 mm. It determines three degrees of freedom."""
    blank = Scene(planes=[(np.array([0.0, 0.0, -1.0]), -1.5)], contrast=0.0)
    rng = np.random.default_rng(0)
    exact = [blank.frame(T, k) for k, T in enumerate(motion)]
    return [replace(f, depth=f.depth + rng.normal(0, 0.001, f.depth.shape).astype(np.float32)) for f in exact]


def test_odometry_completes_motion_along_blank_wall() -> None:
    """Odometry determines the motion along the wall; depth corrects its error of 20 % toward the wall."""
    motion = [pose(0.01 * k, 0.004 * k, 0.005 * k, (0, 0, 0.002 * k)) for k in range(30)]
    measured = [pose(0.01 * k, 0.004 * k, 0.006 * k, (0, 0, 0.002 * k)) for k in range(30)]
    frames = wall(motion)
    assert sum(one.lost for one in tracked(frames, finest_scale=1.0)) > 20
    found = tracked(with_odometry(frames, measured), finest_scale=1.0)
    assert not any(one.lost for one in found)
    assert max(map(error, found, frames)) < 0.004, "expected less than the error of 30 mm of odometry"
    assert found[-1].covariance is None, "the accuracy of odometry is unknown"


def test_odometry_does_not_complete_motion_of_lost_camera() -> None:
    motion = [pose(0.01 * k) for k in range(8)]
    frames = [covered(frame) if k == 5 else frame for k, frame in enumerate(wall(motion))]
    found = tracked(with_odometry(frames, motion), finest_scale=1.0)
    assert [one.lost for one in found] == [False] * 5 + [True] * 3


def test_odometry_bridges_covered_frames() -> None:
    """The covered camera moves 30 cm and turns 16 degrees; covered frames are lost."""
    motion = walk(40)
    frames = [covered(room().frame(T, k)) if 10 <= k < 38 else room().frame(T, k) for k, T in enumerate(motion)]
    without, found = tracked(frames, **NO_FEATURES), tracked(with_odometry(frames, motion), **NO_FEATURES)
    assert all(one.lost for one in without[10:])
    assert [k for k, one in enumerate(found) if one.lost] == list(range(10, 38))
    assert error(found[-1], frames[-1]) < 0.005


def test_odometry_gaps_use_constant_velocity() -> None:
    motion = walk(20)
    frames = [room().frame(T, k) for k, T in enumerate(motion)]
    gaps = [
        frame if k % 3 else replace(frame, T_odom_camera=None) for k, frame in enumerate(with_odometry(frames, motion))
    ]
    found = tracked(gaps, finest_scale=1.0)
    assert not any(one.lost for one in found)
    assert max(map(error, found, frames)) < 0.004
