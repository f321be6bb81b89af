"""RGB-D odometry of Open3D, relative to the map or to the previous frame."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Float32, Float64, Frame, Pose, UInt8
from framework.geometry import nearest_rotation, rotation_angle
from framework.interfaces import PoseTracker, SceneMap, SubmapChange

if TYPE_CHECKING:
    import open3d as o3d

_THREAD_LIMIT = threading.Lock()  # held while Open3D's thread limit, which applies to the whole process, is changed


class Method(Enum):
    """Error that is minimized."""

    POINT_TO_PLANE = "PointToPlane"  # depth only (KinectFusion)
    INTENSITY = "Intensity"  # color only (Steinbruecker et al. 2011)
    HYBRID = "Hybrid"  # depth and color (Park et al. 2017)


class Reference(Enum):
    """Image to which a frame is aligned."""

    PREVIOUS_FRAME = "previous frame"
    MAP = "view of the map from the last pose"


@dataclass(frozen=True)
class _Seen:
    """A frame as an Open3D image, with its pose."""

    image: o3d.t.geometry.RGBDImage
    T_world_camera: Float64  # (4, 4)


@dataclass
class Open3dOdometry(PoseTracker):
    """Multi-scale RGB-D odometry of Open3D, relative to a view of the map or to the previous frame.

    Use POINT_TO_PLANE with the map. Use HYBRID and INTENSITY with the previous frame, because the colors of the map are
    blurred. Poses are repeatable, because Open3D aligns frames with one thread.
    """

    method: Method = Method.POINT_TO_PLANE  # minimized error
    reference: Reference = Reference.MAP  # reference of the alignment
    iterations_coarse: int = 10  # number of iterations at 1/4 of the resolution, in [1, 1000]
    iterations_middle: int = 5  # number of iterations at 1/2 of the resolution, in [1, 1000]
    iterations_fine: int = 3  # number of iterations at full resolution, in [1, 1000]
    max_depth: float = 5.0  # maximum depth of used readings, m, in [0.001, 1000]
    max_distance: float = 0.07  # maximum depth difference of corresponding pixels, m, in [0.0001, 10]
    max_translation: float = 0.3  # maximum translation between frames, m, in [0.001, 100]; above it, the pose is lost
    max_rotation: float = 0.35  # maximum rotation between frames, rad, in [0.001, 3.15]; above it, the pose is lost
    # minimum fraction of the frame's readings with a correspondence, in [0, 1]; below it, the pose is lost
    min_matched: float = 0.3

    def __post_init__(self) -> None:
        check_bounds(
            self, iterations_coarse=(1, 1000), iterations_middle=(1, 1000), iterations_fine=(1, 1000),
            max_depth=(1e-3, 1e3), max_distance=(1e-4, 10.0), max_translation=(1e-3, 100.0), max_rotation=(1e-3, 3.15),
            min_matched=(0.0, 1.0),
        )  # fmt: skip
        import open3d as o3d  # waits for an import in another thread, unlike the import of a submodule

        odometry = o3d.t.pipelines.odometry
        iterations = (self.iterations_coarse, self.iterations_middle, self.iterations_fine)
        self._criteria = [odometry.OdometryConvergenceCriteria(count) for count in iterations]
        self._loss = odometry.OdometryLossParams(depth_outlier_trunc=self.max_distance)
        self._method = getattr(odometry.Method, self.method.value)
        self._last: _Seen | None = None  # last reliable frame
        self._submap = 0  # submap of the next frame

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        image = _rgbd_image(frame.color, frame.depth)
        if self._last is None:
            T_world_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
            if not frame.depth.any():
                return Pose(T_world_camera, lost=True, reason="the frame has no depth")
            self._last = _Seen(image, T_world_camera)
            return Pose(T_world_camera)
        reference = self._last.image
        if self.reference is Reference.MAP:
            view = scene.render_visible(frame.camera, self._last.T_world_camera)
            reference = _rgbd_image(view.color, view.depth)
        T_last_camera, reason = self._aligned(image, reference, frame)
        if reason:
            return Pose(self._last.T_world_camera, lost=True, reason=reason)
        T_world_camera = self._last.T_world_camera @ T_last_camera
        # products of poses and of their inverses amplify rounding errors exponentially
        T_world_camera[:3, :3] = nearest_rotation(T_world_camera[:3, :3])
        self._last = _Seen(image, T_world_camera)
        return Pose(T_world_camera)

    def correct(self, change: SubmapChange) -> None:
        if self._last is not None:
            self._last = _Seen(self._last.image, change.moved(self._submap, self._last.T_world_camera))
        self._submap = change.submap

    def _aligned(
        self, image: o3d.t.geometry.RGBDImage, reference: o3d.t.geometry.RGBDImage, frame: Frame
    ) -> tuple[Float64, str]:
        """Return T_last_camera (4, 4) and the reason for rejecting it, "" = accepted."""
        import open3d as o3d

        readings = np.count_nonzero((frame.depth > 0) & (frame.depth <= self.max_depth))
        if readings == 0:
            return np.eye(4), "the frame has no depth"
        try:
            with _one_thread():
                result = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                    image, reference, _tensor(frame.camera.K), _tensor(np.eye(4)), 1.0, self.max_depth, self._criteria,
                    self._method, self._loss,
                )  # fmt: skip
        except RuntimeError as error:  # "Singular 6x6 linear system": no overlap
            return np.eye(4), f"Open3D did not align the frame: {str(error).strip().splitlines()[-1]}"
        T_last_camera = result.transformation.numpy()
        matched = result.fitness * frame.depth.size / readings
        if not np.isfinite(T_last_camera).all():
            return np.eye(4), "Open3D's alignment diverged"
        if matched < self.min_matched:
            return np.eye(4), f"only {matched:.0%} of the frame's depth readings have a correspondence"
        step = float(np.linalg.norm(T_last_camera[:3, 3]))
        turn = rotation_angle(T_last_camera[:3, :3])
        if step > self.max_translation or turn > self.max_rotation:
            return np.eye(4), f"implausible step of {step:.2f} m and {np.degrees(turn):.0f} deg"
        return T_last_camera, ""


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit Open3D to one thread in the `with` body.

    With several threads, Open3D sums residuals in an order that depends on the timing of the threads.
    """
    import open3d as o3d

    with _THREAD_LIMIT:
        threads = o3d.utility.get_max_threads()
        o3d.utility.set_max_threads(1)
        try:
            yield
        finally:
            o3d.utility.set_max_threads(threads)


def _rgbd_image(color: UInt8, depth: Float32) -> o3d.t.geometry.RGBDImage:
    import open3d as o3d

    return o3d.t.geometry.RGBDImage(o3d.t.geometry.Image(_tensor(color)), o3d.t.geometry.Image(_tensor(depth)))


def _tensor(array: Array) -> o3d.core.Tensor:
    """Return a tensor with a copy of the array."""
    import open3d as o3d

    # Open3D does not keep the array alive
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array)).clone()
