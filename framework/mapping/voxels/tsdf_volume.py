"""A TSDF in our own voxel blocks as maps have it: integration, its surface, views of it, and how it is saved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from framework.data import Array, Camera, Float32, Float64, Frame, InstanceMesh, Int32, SurfaceView
from framework.mapping.gravity import Gravity
from framework.mapping.storage.map_file import check_blocks, check_like, check_numbers
from framework.mapping.storage.map_header import MapHeader
from framework.mapping.voxels.integration import Integrator, SeenBlocks
from framework.mapping.voxels.integration_parameters import BOUNDS, Sensor
from framework.mapping.voxels.meshing import SurfaceNets, UnlabeledMesh
from framework.mapping.voxels.raycasting import render_near, render_surface
from framework.mapping.voxels.voxel_grid import MOST_BLOCKS, VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, find_solid_blocks

BLOCK_ARRAYS = ("block_coords", "tsdf", "weight", "color", "label_row")  # of the grid, that are saved
NO_BLOCKS = np.zeros(0, np.int32)


class TsdfVolume:
    """Voxels, what integrates frames into them, and their surface, which is brought up to date as blocks change."""

    def __init__(self, voxel_size: float, sensor: Sensor, max_blocks: int) -> None:
        self.sensor = sensor
        self.voxels = VoxelGrid(voxel_size, sensor.max_truncation, max_blocks)
        self.integrator = Integrator(self.voxels, sensor)
        self._nets: SurfaceNets | None = None  # made when a mesh is first asked for: who never asks pays nothing
        self._mesh: InstanceMesh | None = None
        self._up: Float64 | None = None
        self.gravity = Gravity()

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: without what is derived from the voxels."""
        return {**vars(self), "_nets": None, "_mesh": None}

    @property
    def voxel_size(self) -> float:
        """m"""
        return float(self.voxels.grid.voxel_size)

    @property
    def voxel_count(self) -> int:
        return self.voxels.block_count * BLOCK_VOXELS

    def integrate(self, frame: Frame, T_world_camera: Float64, near: float) -> SeenBlocks:
        """Integrates one frame and tells what it saw within `near` m of the measured surface.

        Raises MapFullError when the block budget is reached; the frame is then not integrated.
        """
        seen = self.integrator.integrate(frame, T_world_camera, near)
        self.gravity.held(T_world_camera, frame.up)
        self.changed(seen.blocks)
        return seen

    def changed(self, blocks: Int32 | None = None) -> None:
        """To be called after the map was written: what was derived from it is out of date.

        `blocks` (A,) are the numbers of those whose voxels were written; None = perhaps all.
        """
        self._mesh = self._up = None
        if blocks is None:
            self._nets = None
        elif self._nets is not None:
            self._nets.changed(blocks)

    def surface(self) -> UnlabeledMesh:
        """As it is now, without labels."""
        self._nets = self._nets or SurfaceNets(self.voxels)
        return self._nets.extract()

    def up(self) -> Float64 | None:
        """See SceneMap; kept until the map changes."""
        if self._up is None:
            surface = self.surface()
            self._up = self.gravity.up(surface.vertices, surface.triangles)
        return self._up

    def mesh(self, label: Callable[[UnlabeledMesh], InstanceMesh]) -> InstanceMesh:
        """The surface as it is now, with the labels that `label` gives it; kept until the map changes."""
        if self._mesh is None:
            self._mesh = label(self.surface())
        return self._mesh

    def render(self, camera: Camera, T_world_camera: Float64) -> SurfaceView:
        return render_surface(self.voxels, self.sensor, camera, T_world_camera)

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        return render_near(self.voxels, self.sensor, camera, T_world_camera, depth)

    def saved(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """What a map's file has of it: a part of the header, and arrays."""
        b = self.voxels.block_count
        header = {
            "voxel_size": self.voxel_size,
            "sensor": {name: float(value) for name, value in self.sensor._asdict().items()},
            "max_blocks": self.voxels.max_blocks,
            "frames": self.integrator.frames,
            **self.gravity.saved(),
        }
        return header, {name: getattr(self.voxels.grid, name)[:b] for name in BLOCK_ARRAYS}

    @classmethod
    def load(cls, header: MapHeader, arrays: dict[str, Any], rows: int) -> TsdfVolume:
        """The one that `saved` gave, of a map whose labels have so many rows. Raises DataError where it cannot be."""
        saved = header.part("sensor")
        sensor = Sensor(**{name: np.float32(saved.number(name, BOUNDS[name])) for name in Sensor._fields})
        volume = cls(
            header.number("voxel_size", BOUNDS["voxel_size"]), sensor, header.whole("max_blocks", 1, MOST_BLOCKS)
        )
        volume.integrator.frames = header.whole("frames")  # rounding goes on from there
        volume.gravity = Gravity.of(header)
        check_like(arrays, volume.saved()[1], len(arrays["block_coords"]))
        check_numbers("label_row", arrays["label_row"], rows)
        volume.fill(arrays)
        return volume

    def fill(self, arrays: dict[str, Any]) -> None:
        """Gives an empty one the voxels of a saved one, whose types and shapes were checked."""
        coords = arrays["block_coords"]
        check_blocks(coords)
        self.voxels.allocate(coords)
        b = self.voxels.block_count
        for name in arrays.keys() & set(BLOCK_ARRAYS):
            getattr(self.voxels.grid, name)[:b] = arrays[name]
        find_solid_blocks(self.voxels.grid, b)
