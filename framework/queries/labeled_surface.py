"""The map of a run without map.npz: its mesh and its instances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from framework.data import Camera, Float64, Instance, InstanceMesh, Int32
from framework.mapping.instances.instance_list import aligned_box, vertices_by_id
from framework.rendering.rasterizer import Rasterizer, VisibilityBuffer
from framework.runs.instances_file import StoredInstance
from framework.runs.stored_map import read_labeled_mesh


@dataclass(frozen=True)
class LabeledSurface:
    """A mesh with instances. Instances without vertices are left out."""

    classes: tuple[str, ...]
    labeled_mesh: InstanceMesh
    stored: tuple[StoredInstance, ...]

    @classmethod
    def of_run(cls, directory: Path) -> LabeledSurface:
        """Read the mesh and the instances of a run.

        Raises:
            DataError: A file is missing or invalid, or the files are from different runs.
        """
        mesh, instances = read_labeled_mesh(directory)
        return cls(mesh.classes, mesh, tuple(instances))

    def mesh(self) -> InstanceMesh:
        """Return the mesh."""
        return self.labeled_mesh

    def instances(self) -> Mapping[int, Instance]:
        """Return the instances by id."""
        return self._instances

    def render(self, camera: Camera, T_world_camera: Float64) -> VisibilityBuffer:
        """Return the view of the surface from `camera` at T_world_camera (4, 4)."""
        return self._rasterizer.draw(camera, T_world_camera)

    @cached_property
    def _rasterizer(self) -> Rasterizer:
        return Rasterizer(self.labeled_mesh.vertices, self.labeled_mesh.triangles)

    @cached_property
    def _instances(self) -> dict[int, Instance]:
        vertices = vertices_by_id(self.labeled_mesh.instance_ids)
        return {one.id: self._instance(one, vertices[one.id]) for one in self.stored if one.id in vertices}

    def _instance(self, one: StoredInstance, vertices: Int32) -> Instance:
        return Instance(
            id=one.id,
            class_probabilities=np.array([one.class_probabilities.get(name, 0.0) for name in self.classes], np.float32),
            confidence=one.confidence,
            observations=one.observations,
            first_frame=one.first_frame,
            last_frame=one.last_frame,
            vertices=vertices,
            aabb=aligned_box(self.labeled_mesh.vertices[vertices]),
            obb=one.obb,
        )
