"""The map of object instances: voxels, label evidence and the table of instances, as one SceneMap."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64, Frame, InstanceMesh, Int32, View
from framework.mapping.association import look_up_instances
from framework.mapping.evidence import Combine, Evidence, EvidenceRows, Storage
from framework.mapping.instance_list import Confirmation
from framework.mapping.instance_table import InstanceTable
from framework.mapping.labeled_map import LabeledMap
from framework.mapping.map_file import plain_table, read_map, table_of, write_map
from framework.mapping.raycasting import render
from framework.mapping.sensor import Sensor, pinhole
from framework.mapping.tsdf_map import BLOCK_ARRAYS, TsdfMap, saved_sensor
from framework.mapping.vertex_labels import vertex_labels

FORMAT = 4  # of the saved file; a change of meaning counts it up
NO_BLOCKS = np.zeros(0, np.int32)
ARRAYS = (*BLOCK_ARRAYS, *Evidence._fields)


class InstanceMap(TsdfMap, LabeledMap):
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
        TsdfMap.__init__(self, voxel_size, sensor, max_blocks)
        LabeledMap.__init__(self, InstanceTable(combine, logarithmic), confirmation)
        self.labels = EvidenceRows(self.voxels, combine, storage)

    @property
    def byte_count(self) -> int:
        return self.voxels.byte_count + self.labels.byte_count

    @property
    def evictions(self) -> int:
        return self.labels.evicted

    def begin(self, classes: tuple[str, ...]) -> None:
        super().begin(classes)
        self.labels.begin(len(classes))

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

    def labeled_mesh(self) -> InstanceMesh:
        surface = self._surface.extract()
        counts = self.confirmation.counts(self.table)
        colors, instance_ids, class_ids = vertex_labels(self.voxels.grid, self.labels.evidence, counts, surface)
        too_small = self.confirmation.too_small(instance_ids, self.voxel_size)
        instance_ids[too_small] = 0
        class_ids[too_small] = -1
        return InstanceMesh(surface.vertices, surface.triangles, colors, instance_ids, class_ids, self.classes)

    def save(self, path: Path) -> None:
        voxels, arrays = self.saved_voxels()
        header = {
            "format": FORMAT,
            **voxels,
            "confirmation": asdict(self.confirmation),
            "storage": self.labels.storage.name,
            "classes": self.classes,
            "evicted": self.labels.evicted,
            "table": plain_table(self.table),
        }
        r = self.labels.row_count
        arrays |= {name: array[:r] for name, array in self.labels.evidence._asdict().items()}
        write_map(path, header, arrays)

    @classmethod
    def load(cls, path: Path) -> InstanceMap:
        header, arrays = read_map(path, FORMAT, ARRAYS)
        table = table_of(header["table"])
        scene = cls(
            header["voxel_size"],
            saved_sensor(header["sensor"]),
            header["max_blocks"],
            Confirmation(**header["confirmation"]),
            table.combine,
            table.logarithmic,
            Storage[header["storage"]],
        )
        scene.begin(tuple(header["classes"]))
        scene.fill_voxels(arrays)
        scene.labels.evidence = Evidence(**{name: arrays[name] for name in Evidence._fields})
        scene.labels.row_count = len(scene.labels.evidence.instance_ids)
        scene.labels.evicted = header["evicted"]
        scene.table = table
        return scene
