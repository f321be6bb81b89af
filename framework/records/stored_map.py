"""The map that a run left behind, as far as pictures show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from framework.data import Float64, InstanceMesh, Int32, SceneTruth
from framework.errors import DataError
from framework.evaluation.instances import MAX_DISTANCE, transfer_labels
from framework.files.tum_trajectory import read_tum
from framework.records.instances_file import read_instances
from framework.records.mesh_file import read_mesh
from framework.records.stored_runs import Record


@dataclass(frozen=True)
class StoredMap:
    """A map of F frames with V vertices."""

    mesh: InstanceMesh
    ids: Int32  # (V,) 0 = of no instance that the run counted
    class_names: Mapping[int, str]  # by instance
    poses: Float64  # (F, 4, 4) T_world_camera of the frames that were mapped
    record: Record

    @classmethod
    def of(cls, record: Record) -> StoredMap:
        """Raises DataError, naming the file, when one cannot be read or nothing was mapped."""
        mesh = read_mesh(record.directory / "mesh.ply")
        instances = read_instances(record.directory / "instances.json")
        _, poses = read_tum(record.directory / "trajectory.txt")
        if not len(mesh.triangles) or not len(poses):
            raise DataError(f"{record.directory}: nothing was mapped")
        names = {instance.id: instance.class_name for instance in instances}
        ids = np.where(np.isin(mesh.instance_ids, list(names)), mesh.instance_ids, 0).astype(np.int32)
        return cls(mesh, ids, names, poses, record)

    def true_ids(self, truth: SceneTruth) -> Int32:
        """(V,) the true instance nearest to each vertex, 0 = none, or none as near as the evaluation asks."""
        return transfer_labels(truth.points_world, truth.instance_ids, self.mesh.vertices, MAX_DISTANCE)
