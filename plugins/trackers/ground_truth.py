"""The true pose: the upper bound of every tracker, and the way to map with the poses of another system."""

from __future__ import annotations

from dataclasses import dataclass

from framework.data import Frame, Pose
from framework.errors import DataError
from framework.interfaces import PoseTracker, SceneMap


@dataclass
class GroundTruth(PoseTracker):
    """Returns the pose that the sequence comes with."""

    pose_source = "ground_truth"

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Raises DataError for a sequence without poses: there is nothing to fall back on."""
        if frame.T_world_camera is None:
            raise DataError(
                f"tracker=ground_truth: frame {frame.index} has no pose; add the sequence's poses, "
                "or choose tracker=voxel_hashing_icp"
            )
        return Pose(frame.T_world_camera)
