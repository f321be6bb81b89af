"""What maps in our own voxel blocks share: the surface, kept up to date as blocks are written, and how it is saved."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from framework.data import Camera, Float32, Float64, InstanceMesh, Int32, SurfaceView
from framework.interfaces import SceneMap
from framework.mapping.meshing import SurfaceNets
from framework.mapping.raycasting import render_near
from framework.mapping.sensor import Sensor
from framework.mapping.voxel_grid import BLOCK_VOXELS, VoxelGrid, find_solid_blocks

BLOCK_ARRAYS = ("block_coords", "tsdf", "weight", "color", "label_row")  # of the grid, that are saved


class TsdfMap(SceneMap):
    """A TSDF with labels in its voxels; which, a subclass says."""

    def __init__(self, voxel_size: float, sensor: Sensor, max_blocks: int) -> None:
        self.sensor = sensor
        self.voxels = VoxelGrid(voxel_size, sensor.max_truncation, max_blocks)

    @property
    def voxel_size(self) -> float:
        """m"""
        return float(self.voxels.grid.voxel_size)

    @property
    def voxel_count(self) -> int:
        return self.voxels.block_count * BLOCK_VOXELS

    def changed(self, blocks: Int32 | None = None) -> None:
        """To be called after the map was written: what was derived from it is out of date.

        `blocks` (A,) are the numbers of those whose voxels were written; None = perhaps all.
        """
        self.__dict__.pop("_mesh", None)
        if blocks is None:
            self.__dict__.pop("_surface", None)
        elif "_surface" in self.__dict__:
            self._surface.changed(blocks)

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        return render_near(self.voxels, self.sensor, camera, T_world_camera, depth)

    def mesh(self) -> InstanceMesh:
        return self._mesh

    @cached_property
    def _surface(self) -> SurfaceNets:
        """Made when a mesh is first asked for: who never asks pays nothing."""
        return SurfaceNets(self.voxels)

    @cached_property
    def _mesh(self) -> InstanceMesh:
        return self.labeled_mesh()

    @abstractmethod
    def labeled_mesh(self) -> InstanceMesh:
        """The surface as it is now, with its labels; `mesh` keeps it until the map changes."""

    def saved_voxels(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """What a saved map has of the voxels: a part of its header, and arrays."""
        b = self.voxels.block_count
        header = {
            "voxel_size": self.voxel_size,
            "sensor": {name: float(value) for name, value in self.sensor._asdict().items()},
            "max_blocks": self.voxels.max_blocks,
        }
        return header, {name: getattr(self.voxels.grid, name)[:b] for name in BLOCK_ARRAYS}

    def fill_voxels(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Gives an empty map the voxels of a saved one."""
        self.voxels.allocate(arrays["block_coords"])
        b = self.voxels.block_count
        for name in BLOCK_ARRAYS:
            getattr(self.voxels.grid, name)[:b] = arrays[name]
        find_solid_blocks(self.voxels.grid, b)


def saved_sensor(plain: dict[str, float]) -> Sensor:
    """The sensor that a saved map's header names."""
    return Sensor(**{name: np.float32(value) for name, value in plain.items()})
