"""Open3D's dense SLAM (t.pipelines.slam), used and timed as in its example `dense_slam.py`."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from framework.data import Detections, Float64, Frame, Pose

Method = o3d.t.pipelines.odometry.Method

DEPTH_SCALE = 1000.0  # depth units per meter; depth is passed in mm as uint16
MIN_DEPTH, MAX_DEPTH = 0.1, 5.0  # m; MAX_DEPTH is equal to the maximum depth of our fuser
MAX_DEPTH_DIFFERENCE = 0.07  # m, the default
TRUNCATION = 8.0  # voxels, the default
BLOCK = 16  # voxels per side, as in the example
BLOCKS = {0.01: 16_000, 0.02: 4_000}  # capacity by voxel size, m; sufficient for all benchmarks


class Open3DSlam:
    """Open3D's SLAM for one camera, without labels. Each step of a frame is a separate method and can be timed."""

    def __init__(
        self, first: Frame, voxel_size: float, method: Method = Method.PointToPlane, device: str = "CPU:0"
    ) -> None:
        self._device = o3d.core.Device(device)
        camera = first.camera
        K = o3d.core.Tensor(camera.K, o3d.core.float64)
        self._T_world_camera = np.eye(4) if first.T_world_camera is None else first.T_world_camera
        self._method = method
        self._color = method != Method.PointToPlane
        self._model = o3d.t.pipelines.slam.Model(
            voxel_size, BLOCK, BLOCKS[voxel_size], o3d.core.Tensor(self._T_world_camera), self._device
        )
        self._input = o3d.t.pipelines.slam.Frame(camera.height, camera.width, K, self._device)
        self._view = o3d.t.pipelines.slam.Frame(camera.height, camera.width, K, self._device)
        self._K = K
        self._camera = camera
        self._frames = 0

    def load(self, frame: Frame) -> None:
        """Pass the images to Open3D. This is not part of the measured time."""
        depth = np.round(frame.depth * DEPTH_SCALE).astype(np.uint16)
        self._input.set_data_from_image("depth", o3d.t.geometry.Image(o3d.core.Tensor(depth, device=self._device)))
        self._input.set_data_from_image(
            "color", o3d.t.geometry.Image(o3d.core.Tensor(frame.color, device=self._device))
        )

    def __call__(self, frame: Frame, _detections: Detections) -> Pose:
        """Run all steps of a frame. A lost frame is not integrated."""
        self.load(frame)
        pose = self.track()
        if not pose.lost:
            self.integrate()
            self.render()
        return pose

    def track(self) -> Pose:
        """Return the pose of the loaded frame, tracked against the last rendered view."""
        if not self._frames:
            return Pose(self._T_world_camera)
        try:
            result = self._model.track_frame_to_model(
                self._input, self._view, DEPTH_SCALE, MAX_DEPTH, MAX_DEPTH_DIFFERENCE, self._method
            )
        except RuntimeError as error:  # "Singular 6x6 linear system detected, tracking failed."
            return Pose(self._T_world_camera, lost=True, reason=str(error))
        self._T_world_camera = self._T_world_camera @ result.transformation.numpy()
        return Pose(_rigid(self._T_world_camera))

    def integrate(self) -> None:
        self._model.update_frame_pose(self._frames, o3d.core.Tensor(self._T_world_camera))
        self._model.integrate(self._input, DEPTH_SCALE, MAX_DEPTH, TRUNCATION)
        self._frames += 1

    def render(self) -> None:
        """Render the images that the tracker needs: depth, and color if the method uses color."""
        self._model.synthesize_model_frame(self._view, DEPTH_SCALE, MIN_DEPTH, MAX_DEPTH, TRUNCATION, self._color)

    def render_all(self) -> None:
        """Render depth, normals and color of the full image."""
        self._model.voxel_grid.ray_cast(
            self._model.frustum_block_coords,
            self._K,
            o3d.core.Tensor(np.linalg.inv(self._T_world_camera)),
            self._camera.width,
            self._camera.height,
            ["depth", "normal", "color"],
            DEPTH_SCALE,
            MIN_DEPTH,
            MAX_DEPTH,
            1.0,
            TRUNCATION,
        )

    @property
    def bytes_used(self) -> int:
        """Return the size of the blocks in use, bytes."""
        return int(self._model.get_hashmap().size()) * self._bytes_per_block

    @property
    def bytes_allocated(self) -> int:
        """Return the size of all allocated blocks, bytes."""
        return int(self._model.get_hashmap().capacity()) * self._bytes_per_block

    @property
    def _bytes_per_block(self) -> int:
        grid = self._model.voxel_grid
        arrays = [grid.attribute(name) for name in ("tsdf", "weight", "color")]
        return sum(array[0].num_elements() * array.dtype.byte_size() for array in arrays)


def _rigid(T: Float64) -> Float64:
    """Return T with an exact rotation. Rounding errors accumulate in products of many transforms."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = U @ Vt, T[:3, 3]
    return rigid
