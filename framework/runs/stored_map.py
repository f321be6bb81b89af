"""Mesh and instances of a stored run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Float64, InstanceMesh, Int32, SceneTruth
from framework.errors import DataError
from framework.evaluation.instances import MAX_DISTANCE, transfer_labels
from framework.files.folders.staged_files import finish_replacement
from framework.files.tum_trajectory import read_tum
from framework.runs.instances_file import StoredInstance, read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_runs import INSTANCES, MESH, METRICS, TRAJECTORY, Record


@dataclass(frozen=True)
class StoredMap:
    """The map of a stored run, with V vertices and F frames."""

    mesh: InstanceMesh
    ids: Int32  # (V,) instance id of each vertex, 0 = no stored instance
    class_names: Mapping[int, str]  # by instance id
    poses: Float64  # (F, 4, 4) T_world_camera of the mapped frames
    record: Record

    @classmethod
    def of(cls, record: Record) -> StoredMap:
        """Read the map of a run.

        Raises:
            DataError: The map is empty, or its files are invalid or inconsistent.
        """
        mesh, instances = read_objects(record)
        _, poses = read_tum(record.directory / TRAJECTORY)
        if not len(mesh.triangles) or not len(poses):
            raise DataError(f"{record.directory}: expected a map with triangles and poses, got an empty map")
        names = {instance.id: instance.class_name for instance in instances}
        ids = np.where(np.isin(mesh.instance_ids, list(names)), mesh.instance_ids, 0).astype(np.int32)
        return cls(mesh, ids, names, poses, record)

    def true_ids(self, truth: SceneTruth) -> Int32:
        """Return the ids (V,) of the nearest ground-truth instances.

        The id of a vertex is 0 without a ground-truth point within MAX_DISTANCE.
        """
        return transfer_labels(truth.points_world, truth.instance_ids, self.mesh.vertices, MAX_DISTANCE)


def read_objects(record: Record) -> tuple[InstanceMesh, list[StoredInstance]]:
    """Read the mesh and the instances of a completed run.

    Raises:
        DataError: A file is missing or invalid, or the files are from different runs.
    """
    mesh, instances = read_labeled_mesh(record.directory)
    if len(instances) != record.metrics.get("instances.count"):
        raise DataError(
            f"{record.directory / INSTANCES}: expected {record.metrics.get('instances.count')} instances (as "
            f"in {METRICS}), got {len(instances)}; repeat the run, because the files are from different runs"
        )
    return mesh, instances


def read_labeled_mesh(directory: Path) -> tuple[InstanceMesh, list[StoredInstance]]:
    """Read the mesh and the instances of a completed or partial run.

    Raises:
        DataError: A file is missing or invalid, or the files are from different runs.
    """
    finish_replacement(directory)
    mesh_path, instances_path = directory / MESH, directory / INSTANCES
    instances, mesh = read_instances(instances_path), read_mesh(mesh_path)
    ids, counts = np.unique(mesh.instance_ids, return_counts=True)
    vertices = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    for instance in instances:
        if vertices.get(instance.id, 0) != instance.vertices:
            raise DataError(
                f"{instances_path}: expected {vertices.get(instance.id, 0)} vertices of instance {instance.id} "
                f"(as in {mesh_path}), got {instance.vertices}; repeat the run, because the files are from different "
                "runs"
            )
    return mesh, instances
