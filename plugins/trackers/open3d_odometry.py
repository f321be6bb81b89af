"""The off-the-shelf choice: Open3D's RGB-D odometry, between frames or against the map."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Camera, Float32, Float64, Frame, Pose, UInt8
from framework.geometry import nearest_rotation, rotation_angle
from framework.interfaces import PoseTracker, SceneMap

if TYPE_CHECKING:
    import open3d as o3d


class Method(Enum):
    """What is compared."""

    POINT_TO_PLANE = "PointToPlane"  # depth alone (KinectFusion)
    INTENSITY = "Intensity"  # colour alone (Steinbruecker et al. 2011)
    HYBRID = "Hybrid"  # both (Park et al. 2017)


class Reference(Enum):
    """What a frame is compared with."""

    PREVIOUS_FRAME = "previous frame"
    MAP = "view of the map from the last pose"


@dataclass(frozen=True)
class _Seen:
    """A frame in Open3D's form, and where it was taken."""

    image: o3d.t.geometry.RGBDImage
    T_world_camera: Float64  # (4, 4)


@dataclass
class Open3dOdometry(PoseTracker):
    """Aligns each frame to a view of the map, or to the previous frame, with Open3D's multi-scale RGB-D odometry.

    Measured as ATE on 300 frames of redkitchen: POINT_TO_PLANE 31 mm against the map and 123 mm against the previous
    frame; HYBRID and INTENSITY 33 mm against the previous frame, and against the map, whose colours are blurred, they
    lose the camera. Hence the two options `open3d_odometry` and `open3d_odometry_hybrid`.
    """

    method: Method = Method.POINT_TO_PLANE
    reference: Reference = Reference.MAP
    iterations_coarse: int = 10  # >= 1, at 1/4 of the resolution
    iterations_middle: int = 5  # >= 1, at 1/2
    iterations_fine: int = 3  # >= 1, at full resolution
    max_depth: float = 5.0  # m, > 0; farther readings are not used
    max_distance: float = 0.07  # m, > 0: between the depths of a pixel and its partner
    max_step: float = 0.3  # m, > 0: a frame that seems to have moved farther is lost
    max_turn: float = 0.35  # rad, > 0: likewise
    min_matched: float = 0.3  # in [0, 1]: share of the frame's readings that must have a partner

    def __post_init__(self) -> None:
        check_bounds(
            self,
            iterations_coarse=(1, 1000),
            iterations_middle=(1, 1000),
            iterations_fine=(1, 1000),
            max_depth=(1e-3, 1e3),
            max_distance=(1e-4, 10.0),
            max_step=(1e-3, 100.0),
            max_turn=(1e-3, 3.15),
            min_matched=(0.0, 1.0),
        )
        from open3d.t.pipelines import odometry

        iterations = (self.iterations_coarse, self.iterations_middle, self.iterations_fine)
        self._criteria = [odometry.OdometryConvergenceCriteria(count) for count in iterations]
        self._loss = odometry.OdometryLossParams(depth_outlier_trunc=self.max_distance)
        self._method = getattr(odometry.Method, self.method.value)
        self._last: _Seen | None = None  # the last frame whose pose was trusted

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        image = _rgbd_image(frame.color, frame.depth)
        if self._last is None:
            T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            if not frame.depth.any():  # nothing could be aligned to it
                return Pose(T_world_camera, lost=True, reason="the frame has no depth")
            self._last = _Seen(image, T_world_camera)
            return Pose(T_world_camera)
        T_last_camera, reason = self._aligned(image, self._reference(frame.camera, scene, self._last), frame)
        if reason:
            return Pose(self._last.T_world_camera, lost=True, reason=reason)
        T_world_camera = self._last.T_world_camera @ T_last_camera
        # products of poses and of their inverses amplify rounding errors exponentially
        T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
        self._last = _Seen(image, T_world_camera)
        return Pose(T_world_camera)

    def _reference(self, camera: Camera, scene: SceneMap, last: _Seen) -> o3d.t.geometry.RGBDImage:
        """What the frame is aligned to, seen from the last pose."""
        if self.reference is Reference.PREVIOUS_FRAME:
            return last.image
        view = scene.render(camera, last.T_world_camera)
        return _rgbd_image(view.color, view.depth)

    def _aligned(
        self, image: o3d.t.geometry.RGBDImage, reference: o3d.t.geometry.RGBDImage, frame: Frame
    ) -> tuple[Float64, str]:
        """T_last_camera, and one line that says why it is not to be trusted, empty if it is."""
        from open3d.t.pipelines import odometry

        readings = np.count_nonzero((frame.depth > 0) & (frame.depth <= self.max_depth))
        if readings == 0:
            return np.eye(4), "the frame has no depth"
        try:
            result = odometry.rgbd_odometry_multi_scale(
                image,
                reference,
                _tensor(frame.camera.K),
                _tensor(np.eye(4)),
                1.0,
                self.max_depth,
                self._criteria,
                self._method,
                self._loss,
            )
        except RuntimeError as error:  # "Singular 6x6 linear system": nothing in common
            return np.eye(4), f"Open3D could not align the frame: {str(error).strip().splitlines()[-1]}"
        T_last_camera = result.transformation.numpy()
        matched = result.fitness * frame.depth.size / readings
        if not np.isfinite(T_last_camera).all():
            return np.eye(4), "Open3D's alignment diverged"
        if matched < self.min_matched:
            return np.eye(4), f"{matched:.0%} of the frame's readings have a partner"
        step = float(np.linalg.norm(T_last_camera[:3, 3]))
        turn = rotation_angle(T_last_camera[:3, :3])
        if step > self.max_step or turn > self.max_turn:
            return np.eye(4), f"a step of {step:.2f} m and {np.degrees(turn):.0f} deg is not plausible"
        return T_last_camera, ""


def _rgbd_image(color: UInt8, depth: Float32) -> o3d.t.geometry.RGBDImage:
    import open3d as o3d

    return o3d.t.geometry.RGBDImage(o3d.t.geometry.Image(_tensor(color)), o3d.t.geometry.Image(_tensor(depth)))


def _tensor(array: Array) -> o3d.core.Tensor:
    """A copy: Open3D would keep the memory of an array that may be gone."""
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array)).clone()
