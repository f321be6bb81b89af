"""Selection and allocation of the blocks that a frame updates.

A frame updates the blocks near the measured surface and existing blocks in the free space in front of it. The image is
divided into a fixed number of chunks of rows, so that the result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from framework.data import Camera, Float32, Float64, Frame, Int32
from framework.errors import FrameError, MapFullError
from framework.geometry import inverse
from framework.mapping.voxels.allocation_kernels import CHUNKS, choose_blocks, surface_blocks, unpack
from framework.mapping.voxels.integration_parameters import Sensor, pinhole
from framework.mapping.voxels.voxel_grid import VoxelGrid, grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, FARTHEST_BLOCK

MAX_SAMPLES = 4096  # maximum number of samples along the truncation band of a reading, half a block apart
REPEATS = 8  # maximum mean number of entries of a block in the lists of all chunks
MIN_KEYS = 2**20  # number of block keys (8 MB) that a frame may have for any `max_blocks`


class Allocator:
    """Allocator of the blocks updated by a frame."""

    def __init__(self, voxels: VoxelGrid, sensor: Sensor) -> None:
        self.voxels = voxels
        self.sensor = sensor
        self._frames = 0
        self._stamp = np.zeros(0, np.int32)  # (B,) last frame in which each block was active, 0 = none
        self._found = np.empty((CHUNKS, 4096), np.int64)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without unused capacity."""
        return {**vars(self), "_stamp": self._stamp[: self.voxels.block_count]}

    def renumbered(self) -> None:
        """Discard the data about blocks after they were renumbered."""
        self._stamp[:] = 0

    def active_blocks(self, frame: Frame, T_world_camera: Float64) -> Int32:
        """Return the indices (A,) of the blocks that a frame updates.

        Blocks around the measured surface are allocated if they do not exist.

        Raises:
            MapFullError: If the map needs too many blocks.
            FrameError: If the measured surface may be outside the range of block coordinates.
        """
        self._frames += 1
        found = self.allocate(frame.camera, frame.depth, T_world_camera)
        capacity = len(self.voxels.grid.block_coords)
        if len(self._stamp) < capacity:
            self._stamp = grown(self._stamp, capacity, zeros=True)
        active = np.empty(self.voxels.block_count, np.int32)
        grid, regions, view = self.voxels.grid, self.voxels.region_count, pinhole(frame.camera, inverse(T_world_camera))
        count = choose_blocks(grid, found, regions, frame.depth, view, self.sensor, self._stamp, self._frames, active)
        return active[:count].copy()

    def allocate(self, camera: Camera, depth: Float32, T_world_camera: Float64) -> Int32:
        """Allocate the blocks near the measured surface, and return their indices (N,), with repetitions.

        Args:
            camera: The camera.
            depth: The depth image (H, W), m.
            T_world_camera: The camera pose (4, 4).

        Raises:
            MapFullError: If the map needs too many blocks.
            FrameError: If the measured surface may be outside the range of block coordinates.
        """
        return self.voxels.allocate(self._surface_coords(camera, depth, T_world_camera))

    def _surface_coords(self, camera: Camera, depth: Float32, T_world_camera: Float64) -> Int32:
        block_size = BLOCK_SIDE * float(self.voxels.grid.voxel_size)
        # sample spacing of at most a quarter of a block at the maximum depth
        footprint = float(self.sensor.max_depth) / camera.fx
        stride = max(1, min(8, int(0.25 * block_size / footprint)))
        # sample spacing of at most half a block along the longest ray, at the maximum depth of the frame
        farthest = min(float(depth.max()), float(self.sensor.max_depth))
        band = float(self.sensor.truncation) + float(self.sensor.truncation_slope) * farthest
        longest = _longest_ray(camera)
        samples = 1 + int(np.ceil(4 * band * longest / block_size))
        if samples > MAX_SAMPLES:
            raise MapFullError(
                f"fuser.truncation_slope: expected a truncation band of at most {MAX_SAMPLES // 2} blocks, got "
                f"{samples // 2}; raise fuser.voxel_size or lower fuser.truncation_slope"
            )
        reach = float(np.abs(T_world_camera[:3, 3]).max()) + (farthest + band) * longest
        if reach >= FARTHEST_BLOCK * block_size:
            raise FrameError(
                f"tracker: expected surfaces within {FARTHEST_BLOCK * block_size:.6g} m of the origin "
                f"(fuser.voxel_size={self.voxels.grid.voxel_size:g} m), got {reach:.6g} m; check the poses, or raise "
                "fuser.voxel_size"
            )
        counts, view, size = np.zeros(CHUNKS, np.int64), pinhole(camera, T_world_camera), np.float32(block_size)
        while True:
            surface_blocks(depth, view, self.sensor, size, stride, samples, self._found, counts)
            if counts.max() <= self._found.shape[1]:
                break
            if counts.sum() > max(REPEATS * self.voxels.max_blocks, MIN_KEYS):
                raise MapFullError(
                    f"fuser.max_blocks: expected at most {self.voxels.max_blocks} blocks in the map, got at least "
                    f"{counts.sum() // REPEATS} for one frame; raise fuser.max_blocks or fuser.voxel_size, or lower "
                    "fuser.max_depth"
                )
            self._found = np.empty((CHUNKS, 2 * int(counts.max())), np.int64)
        keys = np.concatenate([self._found[chunk, :n] for chunk, n in enumerate(counts)])
        coords = np.empty((len(keys), 3), np.int32)
        unpack(keys, coords)
        return coords


def _longest_ray(camera: Camera) -> float:
    """Return the length of the longest ray of the camera per m of depth."""
    x = max(camera.cx, camera.width - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - camera.cy) / camera.fy
    return float(np.sqrt(1 + x * x + y * y))
