"""How a recording's numbers are meant, where they are not as its format says: poses, axes, units, delays.

Files of others often follow the format but for one convention. `python -m framework check` finds out which it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from framework.config.validation import require
from framework.data import Float64
from framework.datasets.frames.stored_frames import RecordedFrame
from framework.geometry import inverse

COARSEST_DEPTH, FINEST_DEPTH = 1.0, 1e6  # units a metre that stored depth may have; most sensors' have 1000
LONGEST_DELAY = 1000  # frames


class PoseKind(Enum):
    """Which way a pose maps."""

    T_WORLD_CAMERA = "T_world_camera"
    T_CAMERA_WORLD = "T_camera_world"


class CameraAxes(Enum):
    """Where the axes of the camera point that the poses are of, as rotations (3, 3) R_axes_camera from our axes."""

    OPENCV = "x right, y down, z forward"
    OPENGL = "x right, y up, z backward"
    ROS = "x forward, y left, z up"

    @property
    def R_axes_camera(self) -> Float64:
        return _AXES[self.name]


_AXES = {
    "OPENCV": np.eye(3),
    "OPENGL": np.diag([1.0, -1.0, -1.0]),
    "ROS": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}


class QuaternionOrder(Enum):
    """The order of the numbers that were read as x y z w."""

    XYZW = "x y z w"
    WXYZ = "w x y z"


@dataclass(frozen=True)
class PoseReading:
    """What the poses of a recording are, where they are not T_world_camera in OpenCV's axes and metres."""

    pose_kind: PoseKind = PoseKind.T_WORLD_CAMERA
    camera_axes: CameraAxes = CameraAxes.OPENCV
    quaternion_order: QuaternionOrder = QuaternionOrder.XYZW
    pose_unit: float = 1.0  # m, in [1e-6, 1e6], of the poses' translations
    pose_delay: int = 0  # frames, in [-1000, 1000]: the images k belong to the pose k + delay

    def __post_init__(self) -> None:
        require(1e-6 <= self.pose_unit <= 1e6, "dataset.pose_unit", self.pose_unit, "in [1e-6, 1e6] m")
        require(abs(self.pose_delay) <= LONGEST_DELAY, "dataset.pose_delay", self.pose_delay, "in [-1000, 1000]")

    def pose(self, stored: Float64) -> Float64:
        """T_world_camera (4, 4) that the stored rigid motion (4, 4) means."""
        if self == PoseReading():
            return stored
        T = stored.copy()
        if self.quaternion_order is QuaternionOrder.WXYZ:
            T[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), -1)).as_matrix()
        T[:3, 3] *= self.pose_unit
        if self.pose_kind is PoseKind.T_CAMERA_WORLD:
            T = inverse(T)
        T[:3, :3] = T[:3, :3] @ self.camera_axes.R_axes_camera
        return T

    def frames(self, stored: Sequence[RecordedFrame]) -> Sequence[RecordedFrame]:
        """The frames, each with the stored pose that belongs to it; one has a fault where that has, or is not there."""
        if not self.pose_delay:
            return stored
        return [self._delayed(*pair) for pair in with_partners(stored, self.pose_delay)]

    def _delayed(self, frame: RecordedFrame, posed: RecordedFrame | None) -> RecordedFrame:
        if posed is None:
            fault = frame.fault or f"no pose is {self.pose_delay} frames away"
            return replace(frame, T_world_camera=None, fault=fault)
        return replace(frame, T_world_camera=posed.T_world_camera, fault=frame.fault or posed.fault)


@dataclass(frozen=True)
class DepthReading:
    """What the depth images of a recording are, where they are not as its format says."""

    depth_scale: float = 0.0  # units a metre, in [1, 1e6]; 0 = what the recording says
    depth_delay: int = 0  # frames, in [-1000, 1000]: the colour image k belongs to the depth image k + delay

    def __post_init__(self) -> None:
        fine = self.depth_scale == 0 or COARSEST_DEPTH <= self.depth_scale <= FINEST_DEPTH
        require(fine, "dataset.depth_scale", self.depth_scale, f"0 or in [{COARSEST_DEPTH:g}, {FINEST_DEPTH:g}]")
        require(abs(self.depth_delay) <= LONGEST_DELAY, "dataset.depth_delay", self.depth_delay, "in [-1000, 1000]")

    def frames(self, stored: Sequence[RecordedFrame]) -> Sequence[RecordedFrame]:
        """The frames, each with the depth image that belongs to it; one that has none has a fault."""
        if not self.depth_delay:
            return stored
        return [self._delayed(*pair) for pair in with_partners(stored, self.depth_delay)]

    def _delayed(self, frame: RecordedFrame, deep: RecordedFrame | None) -> RecordedFrame:
        if deep is None:
            return replace(frame, fault=frame.fault or f"no depth image is {self.depth_delay} frames away")
        images = replace(frame.images, depth_name=deep.images.depth_name, depth=deep.images.depth)
        return replace(frame, images=images)


def with_partners(stored: Sequence[RecordedFrame], delay: int) -> Iterator[tuple[RecordedFrame, RecordedFrame | None]]:
    """Each frame with the one that is so many frames later, None where there is none."""
    for k, frame in enumerate(stored):
        yield frame, stored[k + delay] if 0 <= k + delay < len(stored) else None
