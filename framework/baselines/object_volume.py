"""A volume of one object: a TSDF that grows where the object's masks show it, and how often each voxel was in them.

After Fusion++ (McCormac et al. 2018): a voxel counts the observations in which a mask of the object lay over it and
those in which none did. Its foreground probability is the mean of the Beta distribution that they make of the uniform
one, and the object's surface is where that is above 1/2. So a mask that bleeds now and then does no harm where the same
place is seen again later; one that always bleeds does.

All that is measured in the volume's blocks is integrated, masked or not, and separated by that probability only: the
distances at an object's outline are as good as elsewhere.

The blocks are those of a VoxelGrid, aligned with all others, and counts take 4 bytes a voxel beside its 8.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from framework.baselines.object_volume_kernels import MaskCounts, count_masks, foreground_at
from framework.data import Array, Bool, Float32, Float64, Frame
from framework.mapping.voxels.integration_parameters import Sensor
from framework.mapping.voxels.tsdf_volume import BLOCK_ARRAYS, TsdfVolume
from framework.mapping.voxels.voxel_grid import grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_SIDE, BLOCK_VOXELS

FOREGROUND = 0.5  # probability above which a voxel is the object's

VOLUME_ARRAYS = (*(name for name in BLOCK_ARRAYS if name != "label_row"), *MaskCounts._fields)  # that are saved


class ObjectVolume:
    """One object's TSDF and mask counts."""

    def __init__(self, voxel_size: float, sensor: Sensor, max_blocks: int) -> None:
        self.volume = TsdfVolume(voxel_size, sensor, max_blocks)
        self.voxels = self.volume.voxels
        self.counts = MaskCounts(np.zeros((0, BLOCK_VOXELS), np.uint16), np.zeros((0, BLOCK_VOXELS), np.uint16))
        self.low = np.full(3, np.inf)  # m: the corners of the box around its blocks
        self.high = np.full(3, -np.inf)

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: without what is only reserved."""
        return {**vars(self), "counts": MaskCounts(*(counts[: self.block_count] for counts in self.counts))}

    @property
    def block_count(self) -> int:
        return self.voxels.block_count

    @property
    def byte_count(self) -> int:
        return self.voxels.byte_count + sum(counts[: self.block_count].nbytes for counts in self.counts)

    def integrate(self, frame: Frame, T_world_camera: Float64, mask: Bool, band: float) -> None:
        """Adds what `frame` measures in the volume, which grows where `mask` (H, W) shows the object.

        Voxels within `band` m of the measured surface count whether they are under the mask. Raises MapFullError when
        the volume's block budget is reached; nothing is added then.
        """
        seen = self.volume.integrator.integrate_object(frame, T_world_camera, band, mask)
        self._grow()
        count_masks(seen, mask, self.counts)
        self._measure()
        self.volume.changed(seen.blocks)

    def _grow(self) -> None:
        """Makes room for the counts of new blocks, which are 0."""
        capacity = len(self.voxels.grid.block_coords)
        if len(self.counts.observed) < capacity:
            self.counts = MaskCounts(*(grown(counts, capacity, zeros=True) for counts in self.counts))

    def _measure(self) -> None:
        coords = self.voxels.grid.block_coords[: self.block_count]
        if len(coords):
            side = BLOCK_SIDE * float(self.voxels.grid.voxel_size)
            self.low, self.high = coords.min(axis=0) * side, (coords.max(axis=0) + 1) * side

    def encloses(self, points_world: Float32) -> Bool:
        """(P,) whether points (P, 3) m lie in the box around the volume's blocks."""
        return np.asarray(((points_world >= self.low) & (points_world <= self.high)).all(axis=1))

    def foreground_at(self, points_world: Float32) -> Float32:
        """(P,) the probability that points (P, 3) m of a surface are the object's."""
        probability = np.empty(len(points_world), np.float32)
        foreground_at(self.voxels.grid, self.counts, points_world, probability)
        return probability

    def arrays(self) -> dict[str, Array]:
        """What is saved of it."""
        arrays = self.volume.saved()[1] | {n: counts[: self.block_count] for n, counts in self.counts._asdict().items()}
        return {name: arrays[name] for name in VOLUME_ARRAYS}

    def fill(self, arrays: dict[str, Any]) -> None:
        """Takes over what `arrays` of another volume gave, into one that is empty."""
        self.volume.fill(arrays)
        self._grow()
        for name, counts in self.counts._asdict().items():
            counts[: self.block_count] = arrays[name]
        self._measure()
