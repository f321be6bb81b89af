"""Ground-truth poses, an upper bound of tracking accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from framework.data import Array, Float64, Frame, Pose
from framework.errors import NoPoseError
from framework.interfaces import PoseTracker, SceneMap


@dataclass
class GroundTruth(PoseTracker):
    """Ground-truth poses of the sequence.

    Frames without a pose are skipped.
    """

    pose_source = "ground_truth"
    poses_given = True

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Return the ground-truth pose of the frame.

        Raises:
            NoPoseError: If the frame has no pose.
        """
        if frame.T_world_camera is None:
            raise NoPoseError(f"frame {frame.index}: expected a ground-truth pose at {frame.timestamp:.3f} s, got none")
        return Pose(frame.T_world_camera)

    def given_pose(self, frame: Frame) -> Float64 | None:
        """Return the ground-truth pose of the frame, None = unknown."""
        return frame.T_world_camera

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """Do nothing, because the ground-truth poses are in the world frame of the map."""
