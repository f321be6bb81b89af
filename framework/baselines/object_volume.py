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

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Array, Bool, Float32, Float64, Frame, Int32
from framework.mapping.labels.vertex_labels import CHUNK, CORNERS, corner_voxels, keep_near
from framework.mapping.voxels.integration_parameters import Pinhole, Sensor
from framework.mapping.voxels.raycasting import voxel_seen
from framework.mapping.voxels.tsdf_volume import BLOCK_ARRAYS, TsdfVolume
from framework.mapping.voxels.voxel_grid import BLOCK_SIDE, BLOCK_VOXELS, Grid, device, grown

FOREGROUND = 0.5  # probability above which a voxel is the object's


class MaskCounts(NamedTuple):
    """What masks said of each voxel."""

    foreground: npt.NDArray[np.uint16]  # (B, 512) observations under a mask of the object
    observed: npt.NDArray[np.uint16]  # (B, 512) all of those in frames that had a mask of it; 65535 at most


VOLUME_ARRAYS = (*(name for name in BLOCK_ARRAYS if name != "label_row"), *MaskCounts._fields)  # that are saved


@device
def _probability(foreground, observed):
    """The mean of Beta(1 + foreground, 1 + observed - foreground)."""
    one = np.float32(1.0)
    return (one + np.float32(foreground)) / (one + one + np.float32(observed))


@njit(cache=True, nogil=True, parallel=True)
def _count_masks(seen, mask, counts):
    """Counts for the seen blocks' voxels near the measured surface whether `mask` (H, W) has their pixel."""
    foreground, observed = counts
    most = np.uint16(65535)
    inside = mask.ravel()
    for a in prange(seen.blocks.shape[0]):
        block = seen.blocks[a]
        first = seen.near_first[a]
        for i in range(first, first + seen.near_count[a]):
            n = seen.near_voxel[i]
            if observed[block, n] < most:
                observed[block, n] += np.uint16(1)
                foreground[block, n] += np.uint16(inside[seen.near_pixel[i]])


@njit(cache=True, nogil=True, parallel=True)
def look_up_object(
    grid: Grid,
    counts: MaskCounts,
    depth: Float32,
    view: Pinhole,
    stride: int,
    window: tuple[int, int, int, int],
    instance_id: int,
    instance_ids: Int32,
    best: Float32,
) -> None:
    """Sets instance_ids (h, w) to `instance_id` where every stride-th reading of every stride-th row of `depth` (H, W)
    m lies in a voxel that is more probably this object's than `best` (h, w), and that to its probability.

    `window` holds the first row and column of (h, w) and those after the last; `view` T_world_camera.
    """
    top, left, bottom, right = window
    for row in prange(top, bottom):
        key = np.int64(-2)
        region = np.int32(-1)
        for column in range(left, right):
            z = depth[row * stride, column * stride]
            if z > np.float32(0.0):
                block, n, key, region = voxel_seen(grid, view, column * stride, row * stride, z, key, region)
                if block >= 0:
                    probability = _probability(counts.foreground[block, n], counts.observed[block, n])
                    if probability > best[row, column]:
                        best[row, column] = probability
                        instance_ids[row, column] = instance_id


@njit(cache=True, nogil=True, parallel=True)
def _foreground_at(grid, counts, points, probability):
    """Fills probability (P,) with that of the foreground at points (P, 3) m, from the counts of the voxels around."""
    for chunk in prange(-(-len(points) // CHUNK)):
        blocks, numbers = np.empty(CORNERS, np.int32), np.empty(CORNERS, np.int32)
        shares = np.empty(CORNERS, np.float32)
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(points))):
            corner_voxels(grid, points[p], blocks, numbers, shares)
            keep_near(grid, blocks, numbers, shares)
            foreground = observed = np.float32(0.0)
            for c in range(CORNERS):
                if shares[c] > 0:
                    foreground += shares[c] * np.float32(counts.foreground[blocks[c], numbers[c]])
                    observed += shares[c] * np.float32(counts.observed[blocks[c], numbers[c]])
            probability[p] = _probability(foreground, observed)


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
        _count_masks(seen, mask, self.counts)
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
        _foreground_at(self.voxels.grid, self.counts, points_world, probability)
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
