"""The contract of a tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Pose
from framework.errors import DataError
from framework.interfaces import PoseTracker
from framework.testing.corner_room import CAMERA, RoomMap, frame_at, pose_at

FRAMES = 6


class TrackerContract:
    """What every tracker keeps. That it leaves the map alone, the map sees to: it is frozen."""

    stage = "tracker"

    def plugin(self) -> PoseTracker:
        raise NotImplementedError("the tracker that is tested")

    def test_tracker_returns_a_pose_and_leaves_the_map_alone(self) -> None:
        tracker = self.plugin()
        scene = RoomMap()
        for k in range(FRAMES):
            pose = tracker.track(frame_at(k), scene)
            assert isinstance(pose, Pose)  # rigid, as every Pose
            assert not pose.lost or pose.reason

    def test_trackers_world_is_the_first_frames_true_pose(self) -> None:
        pose = self.plugin().track(frame_at(4), RoomMap())
        np.testing.assert_allclose(pose.T_world_camera, pose_at(4), atol=1e-12)

    def test_tracker_without_true_poses_starts_at_the_identity_or_says_so(self) -> None:
        tracker = self.plugin()
        try:
            pose = tracker.track(frame_at(0, truth=False), RoomMap())
        except DataError as error:
            assert "\n" not in str(error)
        else:
            np.testing.assert_allclose(pose.T_world_camera, np.eye(4), atol=1e-12)

    def test_tracker_survives_a_frame_without_depth(self) -> None:
        tracker = self.plugin()
        scene = RoomMap()
        tracker.track(frame_at(0), scene)
        blind = replace(frame_at(1), depth=np.zeros(CAMERA.shape, np.float32))
        assert isinstance(tracker.track(blind, scene), Pose)
        assert isinstance(tracker.track(frame_at(2), scene), Pose)
