"""Map with one volume per object and a background volume of the whole scene.

In Fusion++ (McCormac et al., 2018), an object has 64^3 voxels, which are resampled as the object grows. Fusion++
integrates every frame that shows the object, and corrects object poses by loop closures. MaskFusion (Runz et al., 2018)
stores surfels at the pixels of masks and tracks moving objects.

Here, all volumes have the same voxel size, objects are static, and an object is only updated in frames in which it is
detected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from framework.baselines.object_volume import FOREGROUND, OBJECT_ARRAYS, ObjectVolume, boxes_in_view
from framework.baselines.object_volume_kernels import look_up_object
from framework.data import Bool, Camera, Float32, Float64, Frame, InstanceMesh, Int32, SurfaceView, UInt8, View
from framework.errors import DataError, MapFullError
from framework.interfaces import Gravity, MapStatistics
from framework.mapping.instances.instance_list import Confirmation, InstanceTableMap, ListedInstances
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.vertex_labels_kernels import color_vertices
from framework.mapping.storage.map_file import (
    CLASS_EVIDENCE,
    check_like,
    map_contents,
    plain_table,
    table_arrays,
    table_of,
    write_map,
)
from framework.mapping.voxels.integration_parameters import pinhole
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.packed_voxels import STORED_VOXELS
from framework.mapping.voxels.tsdf_volume import NO_BLOCKS, VOLUME_ARRAYS, TsdfVolume
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS
from framework.sensors.noise_models import SensorKind

FORMAT = "object_volumes 6"  # format of the map file; increment it when the meaning of the contents changes
OBJECT = "object_"  # prefix of the names of the arrays with the concatenated volumes of all objects

Part = tuple[Float32, Int32, UInt8, Int32]
"""Vertices (V, 3), m, triangles (F, 3), colors (V, 3) and instance ids (V,) of a part of the mesh."""


class ObjectMap(InstanceTableMap):
    """A map with a background volume, one volume per object and an instance table.

    The class distribution of an object is the mean over its detections.
    """

    def __init__(self, background: TsdfVolume, confirmation: Confirmation) -> None:
        self.classes: tuple[str, ...] = ()
        self.background = background  # voxels of the whole scene
        self.confirmation = confirmation
        self.table = InstanceTable(Combine.SUM, logarithmic=False)
        self.volumes: dict[int, ObjectVolume] = {}
        self.listed = ListedInstances()

    @property
    def block_count(self) -> int:
        """Number of blocks in all volumes."""
        return self.background.voxels.block_count + sum(volume.block_count for volume in self.volumes.values())

    @property
    def statistics(self) -> MapStatistics:
        size = self.background.voxels.byte_count + sum(volume.byte_count for volume in self.volumes.values())
        return MapStatistics(self.block_count * BLOCK_VOXELS, size)

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.background.sensor.depth_range

    def create(self, frame_index: int) -> int:
        """Create an object with an empty volume, and return its id."""
        record = self.table.create(len(self.classes), frame_index)
        self.volumes[record.id] = self._empty_volume()
        return record.id

    def _empty_volume(self) -> ObjectVolume:
        return ObjectVolume(self.background.voxel_size, self.background.sensor, self.background.voxels.max_blocks)

    def remove(self, instance_id: int) -> None:
        """Remove an object and its volume."""
        self.table.remove(instance_id)
        del self.volumes[instance_id]
        self.background.changed(NO_BLOCKS)

    def integrate(self, frame: Frame, T_world_camera: Float64, masks: Mapping[int, Bool], band: float) -> None:
        """Integrate a frame into the background and into the detected objects.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            masks: The mask (H, W) of each detected object by id.
            band: The maximum distance between the measured surface and the voxels that count observations, m.

        Raises:
            MapFullError: If the map needs too many blocks.
        """
        self.background.integrate(frame, T_world_camera, band)
        for instance_id, mask in masks.items():
            self._integrate_object(self.volumes[instance_id], frame, T_world_camera, mask, band)
            if self.block_count > self.background.voxels.max_blocks:
                raise MapFullError(
                    f"fuser.max_blocks: expected at most {self.background.voxels.max_blocks} blocks in the background "
                    f"and {len(self.volumes)} objects, got {self.block_count}; raise fuser.max_blocks or "
                    "fuser.voxel_size"
                )

    def _integrate_object(
        self, volume: ObjectVolume, frame: Frame, T_world_camera: Float64, mask: Bool, band: float
    ) -> None:
        """Integrate the part of the image that contains the object."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        u0, v0, u1, v1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
        if volume.block_count:
            box = self._boxes(frame.camera, T_world_camera, [volume])[0]
            if box[0] < box[2] and box[1] < box[3]:
                u0, v0, u1, v1 = min(u0, box[0]), min(v0, box[1]), max(u1, box[2]), max(v1, box[3])
        part = np.ascontiguousarray(mask[v0:v1, u0:u1])
        volume.integrate(_cropped(frame, u0, v0, u1, v1), T_world_camera, part, band)

    def _boxes(self, camera: Camera, T_world_camera: Float64, volumes: list[ObjectVolume]) -> Int32:
        """Return the pixel window (N, 4) of each volume."""
        low, high = (np.array([getattr(volume, side) for volume in volumes]) for side in ("low", "high"))
        return boxes_in_view(camera, T_world_camera, low, high, float(self.background.sensor.min_depth))

    def instances_seen(self, camera: Camera, T_world_camera: Float64, depth: Float32, stride: int) -> Int32:
        """Return the object at the measured surface at every stride-th pixel of a depth image, 0 = none.

        If several volumes contain a reading, the object with the highest foreground probability is returned. The result
        has the shape (ceil(H / stride), ceil(W / stride)).
        """
        shape = tuple(-(-side // stride) for side in depth.shape)
        instance_ids, best = np.zeros(shape, np.int32), np.full(shape, np.float32(FOREGROUND))
        if not self.volumes:
            return instance_ids
        view = pinhole(camera, T_world_camera)
        boxes = self._boxes(camera, T_world_camera, list(self.volumes.values()))
        for (key, volume), (u0, v0, u1, v1) in zip(self.volumes.items(), boxes.tolist(), strict=True):
            if u0 < u1 and v0 < v1:
                window = -(-v0 // stride), -(-u0 // stride), -(-v1 // stride), -(-u1 // stride)
                grid, counts = volume.voxels.grid, volume.counts
                look_up_object(grid, counts, depth, view, stride, window, key, instance_ids, best)
        return instance_ids

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the view of the background with the labels of the objects."""
        surface = self.background.render(camera, T_world_camera)
        instance_ids = self.instances_seen(camera, T_world_camera, surface.depth, stride=1)
        return View(**vars(surface), instance_ids=instance_ids, class_ids=self.table.class_ids()[instance_ids])

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        return self.background.render_near(camera, T_world_camera, depth, sensor)

    def mesh(self) -> InstanceMesh:
        return self.background.mesh(self._labeled)

    def _labeled(self, background: UnlabeledMesh) -> InstanceMesh:
        """Return the labeled mesh of the background, together with the meshes of the objects.

        The surfaces nearly coincide. The background is labeled, because otherwise the nearest vertex to a ground-truth
        point could be unlabeled by chance. The background also fills holes in the objects.
        """
        counts = self.confirmation.counts(self.table)
        instance_ids = np.zeros(len(background.vertices), np.int32)
        best = np.full(len(background.vertices), np.float32(FOREGROUND))
        objects: list[Part] = []
        for key, volume in self.volumes.items():
            if not counts[key]:
                continue
            surface = volume.volume.surface()
            chosen = volume.foreground_at(surface.vertices) > FOREGROUND
            if chosen.sum() < self.confirmation.min_vertices(self.background.voxel_size):
                continue
            objects.append(_part(surface, volume.voxels, chosen, np.full(len(chosen), key, np.int32)))
            inside = np.flatnonzero(volume.encloses(background.vertices))
            probability = volume.foreground_at(background.vertices[inside])
            better = probability > best[inside]
            best[inside[better]], instance_ids[inside[better]] = probability[better], key
        everything = np.ones(len(best), np.bool_)
        parts = [_part(background, self.background.voxels, everything, instance_ids), *objects]
        vertices, triangles, colors, ids = zip(*parts, strict=True)
        starts = np.cumsum([0, *map(len, vertices)], dtype=np.int32)
        instance_ids = np.concatenate(ids)
        return InstanceMesh(
            vertices=np.concatenate(vertices),
            triangles=np.concatenate([part + start for part, start in zip(triangles, starts, strict=False)]),
            colors=np.concatenate(colors),
            instance_ids=instance_ids,
            class_ids=self.table.class_ids()[instance_ids],
            classes=self.classes,
        )

    def gravity(self) -> Gravity:
        return self.background.gravity()

    def save(self, path: Path | str) -> None:
        voxels, arrays = self.background.saved()
        header = {
            "format": FORMAT,
            **voxels,
            "confirmation": asdict(self.confirmation),
            "classes": self.classes,
            "objects": {key: volume.block_count for key, volume in self.volumes.items()},
            "table": plain_table(self.table),
        }
        parts = [self._empty_volume().arrays(), *(volume.arrays() for volume in self.volumes.values())]
        arrays |= {OBJECT + name: np.concatenate([part[name] for part in parts]) for name in OBJECT_ARRAYS}
        write_map(path, header, arrays | table_arrays(self.table, len(self.classes)), stored=STORED_VOXELS)

    @classmethod
    def load(cls, path: Path | str) -> ObjectMap:
        of_objects = (OBJECT + name for name in OBJECT_ARRAYS)
        with map_contents(path, FORMAT, (*VOLUME_ARRAYS, *of_objects, CLASS_EVIDENCE)) as (header, arrays):
            scene = cls(TsdfVolume.load(header, arrays, 0), Confirmation.of(header.part("confirmation")))
            scene.classes = header.classes()
            scene.table = table_of(header.part("table"), len(scene.classes), arrays)
            objects = header.part("objects")
            if objects.values.keys() != {str(key) for key in scene.table.records}:
                raise DataError(
                    f"header.objects: expected the object ids {', '.join(map(str, scene.table.records))!s:.60}, "
                    f"got {', '.join(objects.values)!s:.60}"
                )
            counts = {int(key): objects.whole(key) for key in objects.values}
            check_like(arrays, scene._empty_volume().arrays(), sum(counts.values()), OBJECT)
            foreground, observed = (arrays[OBJECT + name] for name in ("foreground", "observed"))
            if (wrong := foreground > observed).any():
                raise DataError(
                    f"{OBJECT}foreground: expected at most {observed[wrong][0]} (the value in {OBJECT}observed), got "
                    f"{foreground[wrong][0]}"
                )
            start = 0
            for key, blocks in counts.items():
                volume = scene.volumes[key] = scene._empty_volume()
                volume.fill({name: arrays[OBJECT + name][start : start + blocks] for name in OBJECT_ARRAYS})
                start += blocks
        return scene


def _part(surface: UnlabeledMesh, voxels: VoxelGrid, chosen: Bool, instance_ids: Int32) -> Part:
    """Return the chosen vertices of a surface and the triangles between them.

    Args:
        surface: The surface.
        voxels: The voxel grid with the colors.
        chosen: A Boolean array (V,), True for vertices to keep.
        instance_ids: The instance (V,) of each vertex.
    """
    new_index = np.cumsum(chosen, dtype=np.int32) - np.int32(1)
    triangles = surface.triangles[chosen[surface.triangles].all(axis=1)]
    nearest = surface.voxels[chosen]
    colors = np.empty((len(nearest), 3), np.uint8)
    color_vertices(voxels.grid.color, nearest, colors)
    return surface.vertices[chosen], new_index[triangles], colors, instance_ids[chosen]


def _cropped(frame: Frame, u0: int, v0: int, u1: int, v1: int) -> Frame:
    """Return the part of a frame from (u0, v0) to (u1, v1), exclusive."""
    part = frame.camera.cropped(u0, v0, u1, v1)
    return Frame(
        frame.index, frame.timestamp, frame.color[v0:v1, u0:u1], frame.depth[v0:v1, u0:u1], part, sensor=frame.sensor
    )
