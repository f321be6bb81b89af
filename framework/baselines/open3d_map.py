"""A map of object instances in Open3D's voxel blocks: each voxel votes for the instance that it belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np

from framework.baselines.open3d_grid import ATTRIBUTES, BlockGrid, BlockGridSettings, points_of
from framework.data import Camera, Float32, Float64, Frame, Instance, InstanceMesh, Int32, SurfaceView, View
from framework.geometry import back_project, transform
from framework.interfaces import SceneMap
from framework.mapping.gravity import Gravity
from framework.mapping.instances.association import agreed_classes
from framework.mapping.instances.instance_list import Confirmation, list_instances
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.storage.map_file import (
    check_known,
    faults_of,
    plain_table,
    read_map,
    table_arrays,
    table_of,
    write_map,
)

FORMAT = "open3d_vbg 5"  # of the saved file; a change of meaning counts it up


class Open3DMap(SceneMap):
    """Open3D's voxel blocks and the table of instances as one map.

    An instance's class is that of the table, the same for all its voxels. `mesh` and `instances` have the instances
    that count; `render` and `instances_seen` the tentative ones too.
    """

    def __init__(self, settings: BlockGridSettings, confirmation: Confirmation) -> None:
        self.classes: tuple[str, ...] = ()
        self.table = InstanceTable()
        self.confirmation = confirmation
        self.grid = BlockGrid(settings)
        self.gravity = Gravity()

    @property
    def voxel_count(self) -> int:
        return self.grid.voxel_count

    @property
    def byte_count(self) -> int:
        return self.grid.byte_count

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.grid.settings.min_depth, self.grid.settings.max_depth

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

    def integrate(self, frame: Frame, T_world_camera: Float64) -> None:
        """Adds the depth and the colour of `frame`. Raises MapFullError, and adds nothing, at the end of the budget."""
        self.grid.integrate(frame, T_world_camera)
        self.gravity.held(T_world_camera, frame.up)
        self.changed()

    def vote(self, frame: Frame, T_world_camera: Float64, instance_ids: Int32, band: float) -> None:
        """Each voxel within `band` voxels of the depth measured along its ray votes for the id of its pixel.

        `instance_ids` (H, W), 0 = nothing to say. A voxel holds one candidate and one counter, and ends with the
        majority where there is one: Boyer and Moore, "MJRTY - a fast majority vote algorithm", 1981.
        """
        voxels, pixels = self.grid.voxels_seen(frame, T_world_camera, instance_ids > 0, band)
        ids = instance_ids.ravel()[pixels]
        instance, votes = self.grid.flat("instance"), self.grid.flat("votes")
        old = instance[voxels]
        count = votes[voxels] + np.where(old == ids, np.float32(1), np.float32(-1))
        replaced = count < 0
        instance[voxels] = np.where(replaced, ids, old)
        votes[voxels] = np.abs(count)
        self.changed()

    def merge(self, kept: int, dropped: int) -> None:
        """See LabeledMap."""
        self.table.merge(kept, dropped)
        instance = self.grid.flat("instance")
        instance[instance == dropped] = kept
        self.changed()

    def changed(self) -> None:
        """To be called after the map was written: what was derived from it is out of date."""
        self.__dict__.pop("_mesh", None)

    def instances_at(self, points_world: Float32) -> Int32:
        """(P,) the instance of the voxel nearest to each of the points (P, 3) m; 0 where nothing is mapped."""
        voxels = self.grid.voxels_at(points_world)
        return np.where(voxels >= 0, self.grid.flat("instance")[voxels], 0).astype(np.int32)

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """See LabeledMap."""
        v, u = np.nonzero(frame.depth[::stride, ::stride])
        pixels = np.stack([u * stride, v * stride], axis=1).astype(np.int32)
        points_camera = back_project(frame.camera, pixels, frame.depth[pixels[:, 1], pixels[:, 0]])
        instance_ids = np.zeros((1, *(-(-side // stride) for side in frame.depth.shape)), np.int32)
        instance_ids[0, v, u] = self.instances_at(np.asarray(transform(T_world_camera, points_camera), np.float32))
        return instance_ids

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        surface = self.grid.ray_cast(camera, T_world_camera)
        seen = surface.depth > 0
        instance_ids = np.zeros(camera.shape, np.int32)
        instance_ids[seen] = self.instances_at(points_of(surface)[seen])
        return View(**vars(surface), instance_ids=instance_ids, class_ids=self.table.class_ids()[instance_ids])

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        """The surface without its labels; Open3D has no use for `depth`."""
        return self.grid.ray_cast(camera, T_world_camera)

    def mesh(self) -> InstanceMesh:
        return self._mesh

    @cached_property
    def _mesh(self) -> InstanceMesh:
        vertices, triangles, colors = self.grid.extract()
        ids = self.instances_at(vertices)
        ids[~self.confirmation.counts(self.table)[ids]] = 0
        ids[self.confirmation.too_small(ids, self.grid.settings.voxel_size)] = 0
        return InstanceMesh(vertices, triangles, colors, ids, self.table.class_ids()[ids], self.classes)

    def instances(self) -> Mapping[int, Instance]:
        return list_instances(self.mesh(), self.table, self.up())

    def up(self) -> Float64 | None:
        mesh = self.mesh()
        return self.gravity.up(mesh.vertices, mesh.triangles)

    @property
    def up_is_sensed(self) -> bool:
        return self.gravity.sensed() is not None

    def save(self, path: Path | str) -> None:
        header = {
            "format": FORMAT,
            "settings": asdict(self.grid.settings),
            "confirmation": asdict(self.confirmation),
            "classes": self.classes,
            "frames": self.grid.frames,
            **self.gravity.saved(),
            "table": plain_table(self.table),
        }
        write_map(path, header, self.grid.arrays() | table_arrays(self.table))

    @classmethod
    def load(cls, path: Path | str) -> Open3DMap:
        header, arrays = read_map(path, FORMAT, ("block_coords", *ATTRIBUTES))
        with faults_of(path):
            settings = BlockGridSettings.of(header.part("settings"))
            scene = cls(settings, Confirmation.of(header.part("confirmation")))
            scene.classes = header.classes()
            scene.table = table_of(header.part("table"), len(scene.classes), arrays)
            scene.grid.frames = header.whole("frames")
            scene.gravity = Gravity.of(header)
            scene.grid.fill(arrays)
            check_known("instance", arrays["instance"], [0, *scene.table.records])
        return scene
