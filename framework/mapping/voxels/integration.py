"""Integration of depth images into the TSDF.

The signed distance is measured along the z axis of the camera. Each voxel stores its running average (Curless and
Levoy, 1996). The truncation distance increases with depth, because sensor noise does. Readings beyond
`full_weight_depth` have a lower weight for the same reason.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from framework.data import Bool, Float64, Frame, Int32, Int64, UInt16
from framework.geometry import inverse
from framework.mapping.voxels.allocation import Allocator
from framework.mapping.voxels.integration_kernels import integrate
from framework.mapping.voxels.integration_parameters import Sensor, pinhole
from framework.mapping.voxels.voxel_grid import VoxelGrid, reserved
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS

GOLDEN = 0.6180339887498949  # golden ratio - 1; rounding offsets frac(frame * GOLDEN) avoid biased averages


class SeenBlocks(NamedTuple):
    """The A blocks that a frame updates, and their voxels near the measured surface.

    The voxels of one block are contiguous in the arrays. The arrays are reused for the next frame.
    """

    blocks: Int32  # (A,) block indices
    near_start: Int64  # (A,) start of the near voxels of each block in near_voxel and near_pixel
    near_count: Int32  # (A,) number of near voxels of each block
    near_voxel: UInt16  # (512 A,) index of each near voxel in its block, ascending
    near_pixel: Int32  # (512 A,) index v * width + u of the pixel of each near voxel


def _near_lists(blocks: int) -> tuple[UInt16, Int32]:
    return np.empty(blocks * BLOCK_VOXELS, np.uint16), np.empty(blocks * BLOCK_VOXELS, np.int32)


class Integrator:
    """Integrator of frames into a voxel grid."""

    def __init__(self, voxels: VoxelGrid, sensor: Sensor) -> None:
        self.voxels = voxels
        self.sensor = sensor
        self.frames = 0
        self._allocator = Allocator(voxels, sensor)
        self._near_voxel, self._near_pixel = reserved(voxels.max_blocks, _near_lists)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without per-frame buffers."""
        return {**vars(self), "_near_voxel": self._near_voxel[:0], "_near_pixel": self._near_pixel[:0]}

    def integrate(self, frame: Frame, T_world_camera: Float64, near_band: float) -> SeenBlocks:
        """Integrate one frame, and return the updated blocks.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            near_band: The maximum distance of the listed voxels from the measured surface, m.

        Raises:
            MapFullError: If the map needs too many blocks. The frame is then not integrated.
        """
        return self._update(frame, T_world_camera, near_band, self._allocator.active_blocks(frame, T_world_camera))

    def integrate_object(self, frame: Frame, T_world_camera: Float64, near_band: float, mask: Bool) -> SeenBlocks:
        """Integrate one frame into the grid of a single object, and return the updated blocks.

        New blocks are allocated only inside the `mask` (H, W) of the object. Existing blocks are also updated outside
        the mask.
        """
        depth = np.where(mask, frame.depth, np.float32(0.0))
        self._allocator.allocate(frame.camera, depth, T_world_camera)
        return self._update(frame, T_world_camera, near_band, np.arange(self.voxels.block_count, dtype=np.int32))

    def renumbered(self) -> None:
        """Discard the data about blocks after they were renumbered."""
        self._allocator.renumbered()

    def _sensor_of(self, frame: Frame) -> Sensor:
        """Return the sensor parameters for a frame."""
        # the full-weight depth of the sensor of the frame, if larger
        full_weight_depth = max(self.sensor.full_weight_depth, np.float32(frame.sensor.noise.full_weight_depth))
        return self.sensor._replace(full_weight_depth=full_weight_depth)

    def _update(self, frame: Frame, T_world_camera: Float64, near_band: float, active: Int32) -> SeenBlocks:
        self.frames += 1
        rounding = np.float32((self.frames * GOLDEN) % 1.0)
        view = pinhole(frame.camera, inverse(T_world_camera))
        n = len(active) * BLOCK_VOXELS
        if len(self._near_pixel) < n:  # without reserved memory, or after pickling; old contents are not needed
            self._near_voxel, self._near_pixel = _near_lists(len(active) * 9 // 8 + 1)
        starts, counts = np.empty(len(active), np.int64), np.empty(len(active), np.int32)
        seen = SeenBlocks(active, starts, counts, self._near_voxel[:n], self._near_pixel[:n])
        color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2RGBA).view(np.uint32)
        grid, band = self.voxels.grid, np.float32(near_band)
        integrate(grid, seen, frame.depth, color, view, self._sensor_of(frame), rounding, band)
        return seen
