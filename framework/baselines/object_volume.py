"""Volume of one object: a TSDF with foreground probabilities.

As in Fusion++ (McCormac et al., 2018), a voxel counts its observations inside and outside the masks of the object. The
foreground probability is the mean of a Beta distribution with these counts. The surface of the object is the part of
the TSDF surface with a foreground probability above 1/2. Therefore, occasional mask errors average out.

New blocks are allocated only inside masks. All depth readings in these blocks are integrated, also outside the mask, so
that distances at the outline are accurate.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from framework.baselines.object_volume_kernels import MaskCounts, count_masks, foreground_at
from framework.data import Array, Bool, Camera, Float32, Float64, Frame, Int32
from framework.geometry import inverse
from framework.mapping.voxels.integration_parameters import Sensor
from framework.mapping.voxels.tsdf_volume import BLOCK_ARRAYS, TsdfVolume
from framework.mapping.voxels.voxel_grid import grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS

FOREGROUND = 0.5  # minimum foreground probability of the surface of the object, exclusive

OBJECT_ARRAYS = (*(name for name in BLOCK_ARRAYS if name != "label_row"), *MaskCounts._fields)  # saved arrays


class ObjectVolume:
    """The TSDF and the foreground counts of one object."""

    def __init__(self, voxel_size: float, sensor: Sensor, max_blocks: int) -> None:
        self.volume = TsdfVolume(voxel_size, sensor, max_blocks)
        self.voxels = self.volume.voxels
        self.counts = MaskCounts(np.zeros((0, BLOCK_VOXELS), np.uint16), np.zeros((0, BLOCK_VOXELS), np.uint16))
        self.low = np.full(3, np.inf)  # corners of the bounding box of the blocks, world frame, m
        self.high = np.full(3, -np.inf)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without unused capacity."""
        return {**vars(self), "counts": MaskCounts(*(counts[: self.block_count] for counts in self.counts))}

    @property
    def block_count(self) -> int:
        return self.voxels.block_count

    @property
    def byte_count(self) -> int:
        return self.voxels.byte_count + sum(counts[: self.block_count].nbytes for counts in self.counts)

    def integrate(self, frame: Frame, T_world_camera: Float64, mask: Bool, band: float) -> None:
        """Integrate a frame into the volume.

        New blocks are allocated only inside the mask.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            mask: The mask (H, W) of the object.
            band: The maximum distance between the measured surface and the voxels that count observations, m.

        Raises:
            MapFullError: If the map needs too many blocks. The frame is then not integrated.
        """
        seen = self.volume.integrator.integrate_object(frame, T_world_camera, band, mask)
        self._grow()
        count_masks(seen, mask, self.counts)
        self._update_bounds()
        self.volume.changed(seen.blocks)

    def _grow(self) -> None:
        """Allocate the counts of new blocks."""
        capacity = len(self.voxels.grid.block_coords)
        if len(self.counts.observed) < capacity:
            self.counts = MaskCounts(*(grown(counts, capacity, zeros=True) for counts in self.counts))

    def _update_bounds(self) -> None:
        coords = self.voxels.grid.block_coords[: self.block_count]
        if len(coords):
            side = BLOCK_SIDE * float(self.voxels.grid.voxel_size)
            self.low, self.high = coords.min(axis=0) * side, (coords.max(axis=0) + 1) * side

    def encloses(self, points_world: Float32) -> Bool:
        """Return a Boolean array (P,), True for world points (P, 3), m, inside the bounding box of the blocks."""
        return np.asarray(((points_world >= self.low) & (points_world <= self.high)).all(axis=1))

    def foreground_at(self, points_world: Float32) -> Float32:
        """Return the foreground probability (P,) at world points (P, 3), m, on the surface."""
        probability = np.empty(len(points_world), np.float32)
        foreground_at(self.voxels.grid, self.counts, points_world, probability)
        return probability

    def arrays(self) -> dict[str, Array]:
        """Return the arrays for a map file."""
        arrays = self.volume.arrays() | {n: counts[: self.block_count] for n, counts in self.counts._asdict().items()}
        return {name: arrays[name] for name in OBJECT_ARRAYS}

    def fill(self, arrays: dict[str, Any]) -> None:
        """Copy the arrays of a map file into this empty volume."""
        self.volume.fill(arrays)
        self._grow()
        for name, counts in self.counts._asdict().items():
            counts[: self.block_count] = arrays[name]
        self._update_bounds()


def boxes_in_view(camera: Camera, T_world_camera: Float64, low: Float64, high: Float64, near: float) -> Int32:
    """Return the pixel window (N, 4) of each box: u0, v0, u1, v1, with exclusive u1 and v1.

    A window contains its box, but may be too large. If the box is out of view, the window is empty.

    Args:
        camera: The camera.
        T_world_camera: The camera pose (4, 4).
        low: The minimum corners (N, 3) of the boxes in the world frame, m.
        high: The maximum corners (N, 3) of the boxes in the world frame, m.
        near: The minimum visible depth, m.
    """
    T_camera_world = inverse(T_world_camera)
    center = (low + high) / 2 @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    half = (high - low) / 2 @ np.abs(T_camera_world[:3, :3]).T
    left, top, z0 = (center - half).T
    right, bottom, z1 = (center + half).T
    z0, z1 = np.maximum(z0, near), np.maximum(z1, near)
    # a side of the box projects farthest outward at its minimum depth, or at its maximum depth if the side is on the
    # opposite side of the optical axis
    first = np.stack([camera.fx * np.minimum(left / z0, left / z1), camera.fy * np.minimum(top / z0, top / z1)])
    last = np.stack([camera.fx * np.maximum(right / z0, right / z1), camera.fy * np.maximum(bottom / z0, bottom / z1)])
    middle, size = np.array([[camera.cx], [camera.cy]]), np.array([[camera.width], [camera.height]])
    first = np.clip(np.floor(first + middle), 0, size)
    last = np.clip(np.ceil(last + middle) + 1, 0, size)
    last[:, z1 <= near] = 0
    return np.concatenate([first, last]).T.astype(np.int32)
