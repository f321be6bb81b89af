"""Map of object instances in Open3D's voxel blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np

from framework.baselines.open3d_grid import ATTRIBUTES, BlockGrid, BlockGridSettings, points_of
from framework.data import Camera, Float32, Float64, Frame, InstanceMesh, Int32, SurfaceView, View
from framework.geometry import back_project, transform
from framework.interfaces import Gravity, MapStatistics
from framework.mapping.gravity import GravityEstimator
from framework.mapping.instances.instance_list import Confirmation, InstanceTableMap, ListedInstances
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.storage.map_file import (
    CLASS_EVIDENCE,
    check_known,
    map_contents,
    plain_table,
    table_arrays,
    table_of,
    write_map,
)
from framework.sensors.noise_models import SensorKind

FORMAT = "open3d_vbg 7"  # format of the map file; increment it when the meaning of the contents changes


class Open3DMap(InstanceTableMap):
    """A map of Open3D's voxel blocks with an instance table.

    All voxels of an instance have the class of the instance in the table.
    """

    def __init__(self, settings: BlockGridSettings, confirmation: Confirmation) -> None:
        self.classes: tuple[str, ...] = ()
        self.table = InstanceTable()
        self.confirmation = confirmation
        self.grid = BlockGrid(settings)
        self.gravity_estimator = GravityEstimator()
        self.listed = ListedInstances()

    @property
    def statistics(self) -> MapStatistics:
        return MapStatistics(self.grid.voxel_count, self.grid.byte_count)

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.grid.settings.min_depth, self.grid.settings.max_depth

    def integrate(self, frame: Frame, T_world_camera: Float64) -> None:
        """Integrate one frame.

        Raises:
            MapFullError: If the map needs too many blocks. The frame is then not integrated.
        """
        self.grid.integrate(frame, T_world_camera)
        self.gravity_estimator.add_frame(T_world_camera, frame.up)
        self.changed()

    def vote(self, frame: Frame, T_world_camera: Float64, instance_ids: Int32, band: float) -> None:
        """Add the votes of one frame for the instances of voxels.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            instance_ids: The instance (H, W) at each pixel, 0 = no vote.
            band: The maximum distance of voting voxels from the depth readings, voxels.
        """
        # majority vote with one candidate and one counter per voxel (Boyer and Moore, 1981)
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
        """Merge instance `dropped` into instance `kept`."""
        self.table.merge(kept, dropped)
        instance = self.grid.flat("instance")
        instance[instance == dropped] = kept
        self.changed()

    def remove(self, instance_ids: Sequence[int]) -> None:
        """Remove instances and their votes."""
        for k in instance_ids:
            self.table.remove(k)
        instance = self.grid.flat("instance")
        removed = np.isin(instance, instance_ids)
        instance[removed] = self.grid.flat("votes")[removed] = 0
        self.changed()

    def changed(self) -> None:
        """Discard the cached mesh after a change to the map."""
        self.__dict__.pop("_mesh", None)

    def instances_at(self, points_world: Float32) -> Int32:
        """Return the instance (P,) of the voxel nearest to each world point (P, 3), m, 0 = none."""
        voxels = self.grid.voxels_at(points_world)
        return np.where(voxels >= 0, self.grid.flat("instance")[voxels], 0).astype(np.int32)

    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """Return the most likely instance at every stride-th pixel of a frame, 0 = none.

        See `LabeledMap.instances_seen`.
        """
        v, u = np.nonzero(frame.depth[::stride, ::stride])
        pixels = np.stack([u * stride, v * stride], axis=1).astype(np.int32)
        points_camera = back_project(frame.camera, pixels, frame.depth[pixels[:, 1], pixels[:, 0]])
        instance_ids = np.zeros(tuple(-(-side // stride) for side in frame.depth.shape), np.int32)
        instance_ids[v, u] = self.instances_at(np.asarray(transform(T_world_camera, points_camera), np.float32))
        return instance_ids

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        surface = self.grid.ray_cast(camera, T_world_camera)
        seen = surface.depth > 0
        instance_ids = np.zeros(camera.shape, np.int32)
        instance_ids[seen] = self.instances_at(points_of(surface)[seen])
        return View(**vars(surface), instance_ids=instance_ids, class_ids=self.table.class_ids()[instance_ids])

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        """Return the visible surface without labels.

        Open3D cannot use the depth readings, so `depth` and `sensor` are ignored.
        """
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

    def gravity(self) -> Gravity:
        mesh = self.mesh()
        return self.gravity_estimator.estimate(mesh.vertices, mesh.triangles)

    def save(self, path: Path | str) -> None:
        header = {
            "format": FORMAT,
            "settings": asdict(self.grid.settings),
            "confirmation": asdict(self.confirmation),
            "classes": self.classes,
            "frames": self.grid.frames,
            **self.gravity_estimator.saved(),
            "table": plain_table(self.table),
        }
        write_map(path, header, self.grid.arrays() | table_arrays(self.table, len(self.classes)))

    @classmethod
    def load(cls, path: Path | str) -> Open3DMap:
        with map_contents(path, FORMAT, ("block_coords", *ATTRIBUTES, CLASS_EVIDENCE)) as (header, arrays):
            settings = BlockGridSettings.of(header.part("settings"))
            scene = cls(settings, Confirmation.of(header.part("confirmation")))
            scene.classes = header.classes()
            scene.table = table_of(header.part("table"), len(scene.classes), arrays)
            scene.grid.frames = header.whole("frames")
            scene.gravity_estimator = GravityEstimator.of(header)
            scene.grid.fill(arrays)
            check_known("instance", arrays["instance"], [0, *scene.table.records])
        return scene
