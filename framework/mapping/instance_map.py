"""The map of object instances: voxels, label evidence and the table of instances, as one SceneMap."""

from __future__ import annotations

from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from framework.data import Camera, Float32, Float64, Frame, InstanceMesh, Int32, SurfaceView, View
from framework.mapping.association import look_up_instances
from framework.mapping.evidence import Combine, Evidence, EvidenceRows, Storage
from framework.mapping.instance_list import Confirmation
from framework.mapping.instance_table import InstanceTable
from framework.mapping.labeled_map import LabeledMap
from framework.mapping.map_file import plain_table, read_map, table_of, write_map
from framework.mapping.meshing import SurfaceNets
from framework.mapping.raycasting import render, render_near
from framework.mapping.sensor import Sensor, pinhole
from framework.mapping.vertex_labels import vertex_labels
from framework.mapping.voxel_grid import BLOCK_VOXELS, VoxelGrid, find_solid_blocks

FORMAT = 4  # of the saved file; a change of meaning counts it up
BLOCK_ARRAYS = ("block_coords", "tsdf", "weight", "color", "label_row")  # of the grid, that are saved
NO_BLOCKS = np.zeros(0, np.int32)
ARRAYS = (*BLOCK_ARRAYS, *Evidence._fields)


class InstanceMap(LabeledMap):
    """A TSDF with instance and class evidence in its voxels. Fusers write its parts; everybody else reads."""

    def __init__(
        self,
        voxel_size: float,
        sensor: Sensor,
        max_blocks: int,
        confirmation: Confirmation,
        combine: Combine = Combine.SUM,
        logarithmic: bool = True,
        storage: Storage = Storage.COMPACT,
    ) -> None:
        super().__init__(InstanceTable(combine, logarithmic), confirmation)
        self.sensor = sensor
        self.voxels = VoxelGrid(voxel_size, sensor.max_truncation, max_blocks)
        self.labels = EvidenceRows(self.voxels, combine, storage)

    @property
    def voxel_size(self) -> float:
        """m"""
        return float(self.voxels.grid.voxel_size)

    @property
    def voxel_count(self) -> int:
        return self.voxels.block_count * BLOCK_VOXELS

    @property
    def byte_count(self) -> int:
        return self.voxels.byte_count + self.labels.byte_count

    @property
    def evictions(self) -> int:
        return self.labels.evicted

    def begin(self, classes: tuple[str, ...]) -> None:
        super().begin(classes)
        self.labels.begin(len(classes))

    def changed(self, blocks: Int32 | None = None) -> None:
        """To be called after the map was written: what was derived from it is out of date.

        `blocks` (A,) are the numbers of those whose voxels were written; None = perhaps all.
        """
        self.__dict__.pop("_mesh", None)
        if blocks is None:
            self.__dict__.pop("_surface", None)
        elif "_surface" in self.__dict__:
            self._surface.changed(blocks)

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        instance_ids = np.empty(tuple(-(-side // stride) for side in frame.depth.shape), np.int32)
        view = pinhole(frame.camera, T_world_camera)
        look_up_instances(self.voxels.grid, self.labels.evidence, frame.depth, view, stride, instance_ids)
        return instance_ids

    def merge(self, kept: int, dropped: int) -> None:
        self.table.merge(kept, dropped)
        self.labels.merge_instances(kept, dropped)
        self.changed(NO_BLOCKS)

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        return render(self.voxels, self.labels.evidence, self.sensor, camera, T_world_camera)

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
        surface = self._surface.extract()
        counts = self.confirmation.counts(self.table)
        colors, instance_ids, class_ids = vertex_labels(self.voxels.grid, self.labels.evidence, counts, surface)
        too_small = self.confirmation.too_small(instance_ids, self.voxel_size)
        instance_ids[too_small] = 0
        class_ids[too_small] = -1
        return InstanceMesh(surface.vertices, surface.triangles, colors, instance_ids, class_ids, self.classes)

    def save(self, path: Path) -> None:
        grid, evidence = self.voxels.grid, self.labels.evidence
        b, r = self.voxels.block_count, self.labels.row_count
        header = {
            "format": FORMAT,
            "voxel_size": self.voxel_size,
            "sensor": {name: float(value) for name, value in self.sensor._asdict().items()},
            "max_blocks": self.voxels.max_blocks,
            "confirmation": asdict(self.confirmation),
            "storage": self.labels.storage.name,
            "classes": self.classes,
            "evicted": self.labels.evicted,
            "table": plain_table(self.table),
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            **{name: getattr(grid, name)[:b] for name in BLOCK_ARRAYS},
            **{name: array[:r] for name, array in evidence._asdict().items()},
        }
        write_map(path, header, arrays)

    @classmethod
    def load(cls, path: Path) -> InstanceMap:
        header, arrays = read_map(path, FORMAT, ARRAYS)
        table = table_of(header["table"])
        scene = cls(
            header["voxel_size"],
            Sensor(**{name: np.float32(value) for name, value in header["sensor"].items()}),
            header["max_blocks"],
            Confirmation(**header["confirmation"]),
            table.combine,
            table.logarithmic,
            Storage[header["storage"]],
        )
        scene.begin(tuple(header["classes"]))
        scene.voxels.allocate(arrays["block_coords"])
        b = scene.voxels.block_count
        for name in BLOCK_ARRAYS:
            getattr(scene.voxels.grid, name)[:b] = arrays[name]
        find_solid_blocks(scene.voxels.grid, b)
        scene.labels.evidence = Evidence(**{name: arrays[name] for name in Evidence._fields})
        scene.labels.row_count = len(scene.labels.evidence.instance_ids)
        scene.labels.evicted = header["evicted"]
        scene.table = table
        return scene
