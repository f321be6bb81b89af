"""Conventions of stored poses and depth images, such as axes, units and delays.

They can be set if a recording differs from the default of its format. `instancemap check` detects the conventions of a
recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from framework.config.validation import require
from framework.data import Float64
from framework.errors import DataError
from framework.geometry import inverse

COARSEST_DEPTH, FINEST_DEPTH = 1.0, 1e6  # depth units per meter; most sensors have 1000
LONGEST_DELAY = 1000  # frames, maximum absolute delay of poses and depth images
LEAST_POSE_UNIT, LARGEST_POSE_UNIT = 1e-6, 1e6  # m per unit of the translations
TIME_UNITS = {1e-9: "nanoseconds", 1e-6: "microseconds", 1e-3: "milliseconds"}
"""Units of timestamps other than seconds, s."""

AUTO = "AUTO"  # value of `dataset.color_delay`: estimate the delay
LONGEST_COLOR_DELAY = 0.2  # s, maximum absolute delay of color behind depth


class PoseKind(Enum):
    """Direction of the stored transform."""

    T_WORLD_CAMERA = "T_world_camera"
    T_CAMERA_WORLD = "T_camera_world"


class CameraAxes(Enum):
    """Camera axes of stored poses."""

    OPENCV = "x right, y down, z forward"
    OPENGL = "x right, y up, z backward"
    ROS = "x forward, y left, z up"

    @property
    def R_axes_camera(self) -> Float64:
        """Rotation matrix (3, 3) from OpenCV's axes to these axes."""
        return _AXES[self.name]


_AXES = {
    "OPENCV": np.eye(3),
    "OPENGL": np.diag([1.0, -1.0, -1.0]),
    "ROS": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}


class Mirror(Enum):
    """Mirroring of stored poses, by programs with left-handed coordinates such as Unity and Unreal.

    The world and the camera are mirrored together (S T S with a mirror matrix S), which keeps rotation matrices. If
    only one of them is mirrored, the stored matrices have the determinant -1.
    """

    NONE = "not mirrored"
    X = "world and camera, along x"
    Y = "world and camera, along y"
    Z = "world and camera, along z"
    WORLD = "world only"
    CAMERA = "camera only, along y"

    def undone(self, stored: Float64) -> Float64:
        """Return a stored transform (4, 4) without the mirroring."""
        if self is Mirror.NONE:
            return stored
        if self is Mirror.WORLD:  # in another world frame for another axis, which is arbitrary
            return _FLIPS["Y"] @ stored
        if self is Mirror.CAMERA:
            return stored @ _FLIPS["Y"]
        return _FLIPS[self.name] @ stored @ _FLIPS[self.name]


OF_MATRICES = (Mirror.WORLD, Mirror.CAMERA)
"""Kinds of mirroring in which the determinant of stored matrices is -1."""

_FLIPS = {name: np.diag([1.0 - 2 * (name == axis) for axis in "XYZ"] + [1.0]) for name in "XYZ"}


class QuaternionOrder(Enum):
    """Order of the components of a quaternion."""

    XYZW = "x y z w"
    WXYZ = "w x y z"


MIRRORED_POSE = "a mirrored pose (det R = -1, a left-handed world)"


def is_mirrored(T: Float64) -> bool:
    """Return True if the determinant of the rotation part of a transform (4, 4) is negative."""
    return float(np.linalg.det(T[:3, :3])) < 0


@dataclass(frozen=True)
class PoseReading:
    """Convention of stored poses.

    The default is T_world_camera with OpenCV's axes, in meters.
    """

    pose_kind: PoseKind = PoseKind.T_WORLD_CAMERA  # direction of the stored transforms
    camera_axes: CameraAxes = CameraAxes.OPENCV  # camera axes of the stored poses
    quaternion_order: QuaternionOrder = QuaternionOrder.XYZW  # component order of the stored quaternions
    pose_unit: float = 1.0  # length of one unit of the translations, m, in [1e-6, 1e6]; 0.001 = millimeters
    pose_delay: int = 0  # offset of the pose index, in [-1000, 1000]; image k has pose k + offset
    # mirroring of the stored poses: NONE, X, Y or Z (world and camera, along this axis), WORLD or CAMERA (determinant
    # -1)
    mirrored: Mirror = Mirror.NONE

    def __post_init__(self) -> None:
        require(
            LEAST_POSE_UNIT <= self.pose_unit <= LARGEST_POSE_UNIT,
            "dataset.pose_unit",
            self.pose_unit,
            "a value in [1e-6, 1e6] m",
        )
        require(
            abs(self.pose_delay) <= LONGEST_DELAY,
            "dataset.pose_delay",
            self.pose_delay,
            f"a value in [-{LONGEST_DELAY}, {LONGEST_DELAY}] frames",
        )

    def pose(self, stored: Float64) -> Float64:
        """Convert a stored transform (4, 4) to T_world_camera (4, 4) with OpenCV's axes, in meters.

        The transform is rigid, or mirrored with the determinant -1.

        Raises:
            DataError: The result is not rigid, because `mirrored` does not fit.
        """
        if is_mirrored(stored) != (self.mirrored in OF_MATRICES):
            expected = f"expected {MIRRORED_POSE if not is_mirrored(stored) else 'a rigid transform'}"
            got, fix = ("det R = 1", "NONE") if not is_mirrored(stored) else (MIRRORED_POSE, "WORLD")
            raise DataError(f"pose: {expected}, got {got}; set dataset.mirrored={fix}")
        if self == PoseReading():
            return stored
        T = stored.copy()
        if self.quaternion_order is QuaternionOrder.WXYZ:
            T[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), -1)).as_matrix()
        T = self.mirrored.undone(T)
        T[:3, 3] *= self.pose_unit
        if self.pose_kind is PoseKind.T_CAMERA_WORLD:
            T = inverse(T)
        T[:3, :3] = T[:3, :3] @ self.camera_axes.R_axes_camera
        return T


def color_delay_of(parameter: str) -> float | None:
    """Parse `dataset.color_delay` and return the delay in s, or None for AUTO.

    Raises:
        ConfigError: The text is not a number, or the delay is above LONGEST_COLOR_DELAY.
    """
    if parameter == AUTO:
        return None
    try:
        delay = float(parameter)
    except ValueError:
        delay = math.nan
    limit = LONGEST_COLOR_DELAY
    require(abs(delay) <= limit, "dataset.color_delay", parameter, f"{AUTO} or a value in [-{limit:g}, {limit:g}] s")
    return delay


def check_depth_scale(where: str, depth_scale: float) -> None:
    """Check the depth scale of a calibration file, units per meter.

    Args:
        where: The file and the key, for the error message.
        depth_scale: The depth scale.

    Raises:
        DataError: The scale is implausible.
    """
    if not COARSEST_DEPTH <= depth_scale <= FINEST_DEPTH:
        raise DataError(
            f"{where}: expected {COARSEST_DEPTH:g} to {FINEST_DEPTH:g} units per m (1000 for millimeters), "
            f"got {depth_scale:g}; correct the file"
        )


@dataclass(frozen=True)
class DepthReading:
    """Convention of stored depth images."""

    depth_scale: float = 0.0  # depth units per meter, in [1, 1e6]; 0 = as stored in the recording
    depth_delay: int = 0  # offset of the depth image index, in [-1000, 1000]; color image k has depth image k + offset

    def __post_init__(self) -> None:
        fine = self.depth_scale == 0 or COARSEST_DEPTH <= self.depth_scale <= FINEST_DEPTH
        require(
            fine,
            "dataset.depth_scale",
            self.depth_scale,
            f"0 or a value in [{COARSEST_DEPTH:g}, {FINEST_DEPTH:g}] units per m",
        )
        require(
            abs(self.depth_delay) <= LONGEST_DELAY,
            "dataset.depth_delay",
            self.depth_delay,
            f"a value in [-{LONGEST_DELAY}, {LONGEST_DELAY}] frames",
        )
