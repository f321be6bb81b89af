"""From a depth image to the map: the running averages of the voxels that a frame sees.

The signed distance is projective, along z; its running average is the TSDF of Curless and Levoy (1996). The truncation
distance widens with depth as the sensor's noise does, and the weight of an observation falls with depth squared.

Bytes moved a frame: every block that the frame sees is gone through once. Distances and weights are read and written,
2 * 2 KiB; so are colours, 2 * 2 KiB, where a voxel lies within the truncation band; of each voxel near the measured
surface, a sixth of them, 6 bytes are written for the labels. The images, 2.5 MB at 640x480, stay in the cache. At 1 cm
that is (medians over 40 frames) about 25 MB in redkitchen (2809 blocks seen, 1608 near the surface) and 100 MB in the
synthetic room (10435 and 7953), which two cores copy in 0.9 and 3.5 ms. The kernel takes longer, as it is bound by its
arithmetic: one core, with the caches warm, needs 0.8 microseconds a block in redkitchen and 1.3 in the room, where 0.25
project and gather depths, 0.2 average distances and 0.4 colours; the next block is asked for in advance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from framework.data import Bool, Float64, Frame, Int32, UInt16
from framework.geometry import inverse
from framework.mapping.voxels.allocation import Allocator
from framework.mapping.voxels.integration_kernels import integrate
from framework.mapping.voxels.integration_parameters import Sensor, pinhole
from framework.mapping.voxels.voxel_grid import VoxelGrid, reserved
from framework.mapping.voxels.voxel_grid_kernels import (
    BLOCK_VOXELS,
)

GOLDEN = 0.6180339887498949  # rounding offsets frac(k * GOLDEN) are spread evenly, so rounded averages have no bias


class SeenBlocks(NamedTuple):
    """The A blocks that a frame has updated, and their voxels near the measured surface; valid until the next frame.

    Those of a block lie one behind the other; between GROUPs of blocks there are gaps.
    """

    blocks: Int32  # (A,) their numbers
    near_first: npt.NDArray[np.int64]  # (A,) where the voxels of each block begin that lie near the surface
    near_count: Int32  # (A,) how many these are
    near_voxel: UInt16  # (512 A,) their numbers in the block, ascending
    near_pixel: Int32  # (512 A,) the number v * width + u of the pixel that sees each of these


def _near_lists(blocks: int) -> tuple[UInt16, Int32]:
    """The near_voxel and near_pixel of so many blocks."""
    return np.empty(blocks * BLOCK_VOXELS, np.uint16), np.empty(blocks * BLOCK_VOXELS, np.int32)


class Integrator:
    """Integrates frames into a grid; remembers what it needs between frames."""

    def __init__(self, voxels: VoxelGrid, sensor: Sensor) -> None:
        self.voxels = voxels
        self.sensor = sensor
        self.frames = 0
        self._allocator = Allocator(voxels, sensor)
        self._near_voxel, self._near_pixel = reserved(voxels.max_blocks, _near_lists)

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: without what the next frame overwrites."""
        return {**vars(self), "_near_voxel": self._near_voxel[:0], "_near_pixel": self._near_pixel[:0]}

    def integrate(self, frame: Frame, T_world_camera: Float64, near_band: float) -> SeenBlocks:
        """Integrates one frame and tells what it saw within near_band m of the measured surface.

        Raises MapFullError when the block budget is reached; the frame is then not integrated.
        """
        return self._update(frame, T_world_camera, near_band, self._allocator.active_blocks(frame, T_world_camera))

    def integrate_object(self, frame: Frame, T_world_camera: Float64, near_band: float, mask: Bool) -> SeenBlocks:
        """Like `integrate`, for a grid of one object: it grows where `mask` (H, W) shows the object, and nowhere else.

        What is measured outside the mask is integrated into the blocks that there are, all of which are gone through.
        """
        depth = np.where(mask, frame.depth, np.float32(0.0))
        self._allocator.allocate(frame.camera, depth, T_world_camera)
        return self._update(frame, T_world_camera, near_band, np.arange(self.voxels.block_count, dtype=np.int32))

    def _update(self, frame: Frame, T_world_camera: Float64, near_band: float, active: Int32) -> SeenBlocks:
        self.frames += 1
        rounding = np.float32((self.frames * GOLDEN) % 1.0)
        view = pinhole(frame.camera, inverse(T_world_camera))
        first, count = np.empty(len(active), np.int64), np.empty(len(active), np.int32)
        n = len(active) * BLOCK_VOXELS
        if len(self._near_pixel) < n:  # where reserving costs memory, or after pickling; nothing is copied
            self._near_voxel, self._near_pixel = _near_lists(len(active) * 9 // 8 + 1)
        seen = SeenBlocks(active, first, count, self._near_voxel[:n], self._near_pixel[:n])
        integrate(
            self.voxels.grid,
            active,
            frame.depth,
            cv2.cvtColor(frame.color, cv2.COLOR_RGB2RGBA).view(np.uint32),
            view,
            self.sensor,
            rounding,
            np.float32(near_band),
            seen.near_first,
            seen.near_count,
            seen.near_voxel,
            seen.near_pixel,
        )
        return seen
