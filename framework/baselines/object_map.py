"""A map of objects with a volume each, before a background volume of everything.

What differs from its models: Fusion++ (McCormac et al. 2018) gives an object 64^3 voxels whatever its size, resamples
them as the object grows, integrates into it every frame that sees it, corrects the poses of its objects by loop
closures, and has but a coarse background for tracking. MaskFusion (Runz et al. 2018) has surfels, only of what is under
the masks, and tracks objects that move. Here all volumes have blocks of the same voxels, objects do not move, and an
object's volume changes in the frames that detect it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from framework.baselines.object_volume import FOREGROUND, VOLUME_ARRAYS, ObjectVolume
from framework.baselines.object_volume_kernels import look_up_object
from framework.data import (
    Bool,
    Camera,
    Float32,
    Float64,
    Frame,
    Instance,
    InstanceMesh,
    Int32,
    SurfaceView,
    UInt8,
    View,
)
from framework.errors import DataError, MapFullError
from framework.interfaces import SceneMap
from framework.mapping.instances.association import agreed_classes
from framework.mapping.instances.instance_list import Confirmation, list_instances
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.labels.label_evidence_kernels import Combine
from framework.mapping.labels.vertex_labels import vertex_colors
from framework.mapping.storage.map_file import (
    check_like,
    faults_of,
    plain_table,
    read_map,
    table_arrays,
    table_of,
    write_map,
)
from framework.mapping.voxels.frustum import boxes_in_view
from framework.mapping.voxels.integration_parameters import pinhole
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.tsdf_volume import BLOCK_ARRAYS, NO_BLOCKS, TsdfVolume
from framework.mapping.voxels.voxel_grid import VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS

FORMAT = "object_volumes 4"  # of the saved file; a change of meaning counts it up
OBJECT = "object_"  # before the names of the arrays that hold all objects' volumes, one after the other


class ObjectMap(SceneMap):
    """The background, the objects' volumes by id, and the table of what is known of the objects beside them.

    An object's classes are the mean of its detections' distributions. `mesh` and `instances` have the objects that
    count; `render` and `instances_seen` the tentative ones too.
    """

    def __init__(self, background: TsdfVolume, confirmation: Confirmation) -> None:
        self.classes: tuple[str, ...] = ()
        self.background = background  # voxels of everything
        self.confirmation = confirmation
        self.table = InstanceTable(Combine.SUM, logarithmic=False)
        self.volumes: dict[int, ObjectVolume] = {}

    @property
    def block_count(self) -> int:
        """Of the background and of all objects."""
        return self.background.voxels.block_count + sum(volume.block_count for volume in self.volumes.values())

    @property
    def voxel_count(self) -> int:
        return self.block_count * BLOCK_VOXELS

    @property
    def byte_count(self) -> int:
        return self.background.voxels.byte_count + sum(volume.byte_count for volume in self.volumes.values())

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.background.sensor.depth_range

    @property
    def embedding_space(self) -> str:
        return self.table.embedding_space

    @property
    def instance_count(self) -> int:
        """Without the condition on their area, which takes a mesh."""
        return self.confirmation.count(self.table)

    def instance_ids(self) -> frozenset[int]:
        return self.confirmation.ids(self.table)

    def most_likely_classes(self) -> Mapping[int, tuple[int, float]]:
        return self.confirmation.most_likely_classes(self.table)

    def begin(self, classes: tuple[str, ...]) -> None:
        """Takes the first frame's label space for the map's. Raises DataError for another one later."""
        self.classes = agreed_classes(self.classes, classes)

    def create(self, frame_index: int) -> int:
        """The id of a new object, whose volume is empty."""
        record = self.table.create(len(self.classes), frame_index)
        self.volumes[record.id] = self._empty_volume()
        return record.id

    def _empty_volume(self) -> ObjectVolume:
        return ObjectVolume(self.background.voxel_size, self.background.sensor, self.background.voxels.max_blocks)

    def remove(self, instance_id: int) -> None:
        """Forgets an object."""
        del self.table.records[instance_id], self.volumes[instance_id]
        self.background.changed(NO_BLOCKS)

    def integrate(self, frame: Frame, T_world_camera: Float64, masks: Mapping[int, Bool], band: float) -> None:
        """Adds `frame` to the background, and to the volumes of the objects whose `masks` (H, W) it has, by id.

        Voxels within `band` m of the measured surface count whether they are under their object's mask. Raises
        MapFullError when the block budget is reached.
        """
        self.background.integrate(frame, T_world_camera, band)
        for instance_id, mask in masks.items():
            self._integrate_object(self.volumes[instance_id], frame, T_world_camera, mask, band)
            if self.block_count > self.background.voxels.max_blocks:
                raise MapFullError(
                    f"the map is full: more than {self.background.voxels.max_blocks} blocks in the background and "
                    f"{len(self.volumes)} objects; raise fuser.max_blocks or fuser.voxel_size"
                )

    def _integrate_object(
        self, volume: ObjectVolume, frame: Frame, T_world_camera: Float64, mask: Bool, band: float
    ) -> None:
        """Adds the part of the image in which the object's volume or its mask lies."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        u0, v0, u1, v1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
        if volume.block_count:
            box = self._boxes(frame.camera, T_world_camera, [volume])[0]
            if box[0] < box[2] and box[1] < box[3]:
                u0, v0, u1, v1 = min(u0, box[0]), min(v0, box[1]), max(u1, box[2]), max(v1, box[3])
        part = np.ascontiguousarray(mask[v0:v1, u0:u1])
        volume.integrate(_cropped(frame, u0, v0, u1, v1), T_world_camera, part, band)

    def _boxes(self, camera: Camera, T_world_camera: Float64, volumes: list[ObjectVolume]) -> Int32:
        """(M, 4) u0, v0, u1, v1: see boxes_in_view()."""
        low, high = (np.array([getattr(volume, side) for volume in volumes]) for side in ("low", "high"))
        return boxes_in_view(camera, T_world_camera, low, high, float(self.background.sensor.min_depth))

    def instances_seen(self, camera: Camera, T_world_camera: Float64, depth: Float32, stride: int) -> Int32:
        """(ceil(H / stride), ceil(W / stride)) the object at every stride-th reading of every stride-th row of `depth`
        (H, W) m, 0 = none: of those whose volumes hold it, the one that it most probably belongs to.

        Beside a test for each box around an object, the cost is that of the objects in view.
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
        """The background's surface, which is also that of the objects, with the objects that it belongs to."""
        surface = self.background.render(camera, T_world_camera)
        instance_ids = self.instances_seen(camera, T_world_camera, surface.depth, stride=1)
        return View(**vars(surface), instance_ids=instance_ids, class_ids=self.table.class_ids()[instance_ids])

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        return self.background.render_near(camera, T_world_camera, depth)

    def mesh(self) -> InstanceMesh:
        return self.background.mesh(self._labeled)

    def _labeled(self, background: UnlabeledMesh) -> InstanceMesh:
        """The background's surface, with the object that it most probably belongs to, and the objects' own surfaces.

        Both were measured by the same readings and nearly coincide: were the background's without a label there, which
        of the two is nearer to a true point would be chance; were it left out, there would be seams, and holes where
        an object's volume has seen too little. Where objects overlap, each has its surface.
        """
        counts = self.confirmation.counts(self.table)
        instance_ids = np.zeros(len(background.vertices), np.int32)
        best = np.full(len(background.vertices), np.float32(FOREGROUND))
        objects: list[_Part] = []
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
        return self._joined([_part(background, self.background.voxels, everything, instance_ids), *objects])

    def _joined(self, parts: list[_Part]) -> InstanceMesh:
        firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        instance_ids = np.concatenate([part.instance_ids for part in parts])
        return InstanceMesh(
            vertices=np.concatenate([part.vertices for part in parts]),
            triangles=np.concatenate(
                [part.triangles + np.int32(first) for first, part in zip(firsts, parts, strict=False)]
            ),
            colors=np.concatenate([part.colors for part in parts]),
            instance_ids=instance_ids,
            class_ids=self.table.class_ids()[instance_ids],
            classes=self.classes,
        )

    def instances(self) -> Mapping[int, Instance]:
        return list_instances(self.mesh(), self.table, self.up())

    def up(self) -> Float64 | None:
        return self.background.up()

    @property
    def up_is_sensed(self) -> bool:
        return self.background.gravity.sensed() is not None

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
        arrays |= {OBJECT + name: np.concatenate([part[name] for part in parts]) for name in VOLUME_ARRAYS}
        write_map(path, header, arrays | table_arrays(self.table))

    @classmethod
    def load(cls, path: Path | str) -> ObjectMap:
        header, arrays = read_map(path, FORMAT, (*BLOCK_ARRAYS, *(OBJECT + name for name in VOLUME_ARRAYS)))
        with faults_of(path):
            scene = cls(TsdfVolume.load(header, arrays, 0), Confirmation.of(header.part("confirmation")))
            scene.classes = header.classes()
            scene.table = table_of(header.part("table"), len(scene.classes), arrays)
            objects = header.part("objects")
            if objects.values.keys() != {str(key) for key in scene.table.records}:
                raise DataError("header.objects must be the instances of its table")
            counts = {int(key): objects.whole(key) for key in objects.values}
            check_like(arrays, scene._empty_volume().arrays(), sum(counts.values()), OBJECT)
            if (arrays[OBJECT + "foreground"] > arrays[OBJECT + "observed"]).any():
                raise DataError(f"{OBJECT}foreground must not be above {OBJECT}observed, of which it is a part")
            first = 0
            for key, blocks in counts.items():
                volume = scene.volumes[key] = scene._empty_volume()
                volume.fill({name: arrays[OBJECT + name][first : first + blocks] for name in VOLUME_ARRAYS})
                first += blocks
        return scene


class _Part(NamedTuple):
    """A surface that becomes a part of the mesh."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    colors: UInt8  # (V, 3) RGB
    instance_ids: Int32  # (V,), 0 = none


def _part(surface: UnlabeledMesh, voxels: VoxelGrid, chosen: Bool, instance_ids: Int32) -> _Part:
    """The chosen (V,) vertices of a grid's surface, and the triangles between them."""
    number = np.cumsum(chosen, dtype=np.int32) - np.int32(1)
    triangles = surface.triangles[chosen[surface.triangles].all(axis=1)]
    colors = vertex_colors(voxels.grid, surface.voxels[chosen])
    return _Part(surface.vertices[chosen], number[triangles], colors, instance_ids[chosen])


def _cropped(frame: Frame, u0: int, v0: int, u1: int, v1: int) -> Frame:
    """The part of a frame from pixel (u0, v0) to before (u1, v1)."""
    camera = frame.camera
    part = replace(camera, width=u1 - u0, height=v1 - v0, cx=camera.cx - u0, cy=camera.cy - v0)
    return Frame(frame.index, frame.timestamp, frame.color[v0:v1, u0:u1], frame.depth[v0:v1, u0:u1], part)
