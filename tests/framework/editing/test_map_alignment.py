"""Tests for the alignment of maps of a textured room."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from framework.data import Pose
from framework.editing.map_alignment import KeyframedMap, align_maps
from framework.errors import DataError
from framework.geometry import exp_se3, inverse, pose_distance, transform
from framework.queries.changes import Visit
from framework.tracking.keyframes import Keyframe, Keyframes
from tests.support import registered
from tests.support.scenes.analytic_scene import NOTHING
from tests.support.scenes.papered_room import papered_frame

T_A_B = exp_se3(np.array([2.0, -0.7, 1.1, 0.4, -1.9, 0.3]))
VOXEL = 0.05  # m


@cache
def map_of(first: float, last: float, here: bool = True, paper: int = 0) -> KeyframedMap:
    """Return the map of the views from angle `first` to angle `last` in the world frame of map A (here) or B."""
    T_other_world = np.eye(4) if here else inverse(T_A_B)
    fuser, keyframes, poses = registered.built("fuser", "bayesian_tsdf", f"fuser.voxel_size={VOXEL}"), Keyframes(), []
    for k, yaw in enumerate(np.arange(first, last, 0.2)):
        frame = papered_frame(exp_se3(np.array([0.1 * np.sin(yaw), 0, 0, 0.2 * np.sin(yaw), yaw, 0])), k, paper)
        assert frame.T_world_camera is not None
        poses.append(T_other_world @ frame.T_world_camera)
        frame = replace(frame, T_world_camera=poses[-1])
        keyframes.add(frame, poses[-1])
        fuser.fuse(frame, Pose(poses[-1]), NOTHING)
    return KeyframedMap(Visit(fuser.scene, np.array(poses)), [*keyframes])


def test_aligned_maps_agree_within_fraction_of_voxel() -> None:
    found = align_maps(map_of(0.0, 2.0), map_of(1.0, 3.0, here=False))
    assert pose_distance(found, T_A_B) < 0.2 * VOXEL


def test_alignment_of_different_rooms_raises() -> None:
    with pytest.raises(DataError, match="expected an overlap with at least 40 consistent feature matches"):
        align_maps(map_of(0.0, 2.0), map_of(0.0, 2.0, paper=1))


def moved_keyframes(one: KeyframedMap, *twist: float) -> list[Keyframe]:
    """Return the keyframes of a map with points moved by a twist, m and rad."""
    T = exp_se3(np.array(twist))
    return [replace(key, points_world=transform(T, key.points_world)) for key in one.keyframes]


def test_alignment_without_keyframes_raises() -> None:
    with pytest.raises(DataError, match="expected keyframes in both runs, got 0 and"):
        align_maps(replace(map_of(0.0, 2.0), keyframes=()), map_of(1.0, 3.0, here=False))


def test_alignment_with_wrong_features_raises() -> None:
    """The features agree with a transform that the surfaces contradict, as in a similar room of another size."""
    a, b = map_of(0.0, 2.0), map_of(1.0, 3.0, here=False)
    with pytest.raises(DataError, match="expected surfaces that agree on at least 80% of the overlap"):
        align_maps(replace(a, keyframes=moved_keyframes(a, 0.0, 0.0, 0.6, 0.0, 0.2, 0.0)), b)


def test_alignment_without_common_views_raises() -> None:
    a, b = map_of(0.0, 2.0), map_of(1.0, 3.0, here=False)
    with pytest.raises(DataError, match="expected an overlap of at least 5%, got 0%"):
        align_maps(replace(a, keyframes=moved_keyframes(a, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0)), b)


def test_alignment_with_repeated_room_raises() -> None:
    """The first map contains the room of the second map twice."""
    a, b = map_of(0.0, 2.0), map_of(1.0, 3.0, here=False)
    again = moved_keyframes(a, 7.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(DataError, match="expected one transform, got two"):
        align_maps(replace(a, keyframes=[*a.keyframes, *again]), b)
