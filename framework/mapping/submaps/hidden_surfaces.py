"""Surfaces of hidden submaps, which another thread may render while the map changes."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from framework.data import Camera, Float32, Float64, SurfaceView
from framework.interfaces import SubmapSurfaces
from framework.mapping.submaps.fusion import fuse_grids
from framework.mapping.submaps.hidden_submap import HiddenSubmap
from framework.mapping.voxels.integration_parameters import Sensor
from framework.mapping.voxels.raycasting import render_surface
from framework.mapping.voxels.voxel_grid import VoxelGrid


class HiddenSurfaces(SubmapSurfaces):
    """The surfaces of hidden submaps. Those rendered last remain in memory."""

    def __init__(
        self, hidden: Mapping[int, HiddenSubmap], like: VoxelGrid, sensor: Sensor, earlier: HiddenSurfaces | None = None
    ) -> None:
        """Store the hidden submaps by number.

        Args:
            hidden: The submaps.
            like: A grid with the parameters of their voxels.
            sensor: The parameters of integration.
            earlier: Surfaces rendered earlier. Those that have not changed are kept.
        """
        self.hidden = dict(hidden)
        self.sensor = sensor
        self._empty = like.like(1)
        self._grids: dict[int, VoxelGrid] = {}  # the submaps rendered last
        self._joined: tuple[tuple[int, ...], VoxelGrid] | None = None  # their numbers and their fusion
        if earlier is not None:
            same = [k for k in earlier._grids if self.hidden.get(k) is earlier.hidden[k]]
            self._grids = {k: earlier._grids[k] for k in same}

    def are_of(self, hidden: Mapping[int, HiddenSubmap]) -> bool:
        """Return True if these are the surfaces of the given submaps."""
        return self.hidden.keys() == hidden.keys() and all(self.hidden[k] is hidden[k] for k in hidden)

    def render(
        self, camera: Camera, T_world_camera: Float64, submaps: Collection[int], depth: Float32 | None = None
    ) -> SurfaceView:
        chosen = tuple(sorted(self.hidden.keys() & set(submaps)))
        if self._joined is None or self._joined[0] != chosen:
            self._grids = {k: self._grids.get(k) or self.hidden[k].surface(self._empty) for k in chosen}
            self._joined = chosen, self._fused([*self._grids.values()])
        return render_surface(self._joined[1], self.sensor, camera, T_world_camera, depth)

    def _fused(self, grids: list[VoxelGrid]) -> VoxelGrid:
        if len(grids) == 1:
            return grids[0]
        joined = self._empty.like(max(sum(grid.block_count for grid in grids), 1))
        for grid in grids:
            fuse_grids(joined, grid, float(self.sensor.max_weight))
        return joined
