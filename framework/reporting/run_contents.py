"""The outputs of a run that are shown in a report."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from framework.data import UNIT_TOLERANCE, Float64, InstanceMesh, Int32
from framework.errors import DataError
from framework.files.atomic_write import check_regular, path_exists
from framework.files.folders.staged_files import finish_replacement
from framework.files.tum_trajectory import read_tum
from framework.interfaces import SubmapGraph
from framework.pose_graph.depth_distortion_file import read_depth_distortion
from framework.pose_graph.graph_file import read_pose_graph
from framework.rendering.viewpoint import surrounding_poses
from framework.runs.instances_file import StoredInstance, read_instances
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_map import read_objects
from framework.runs.stored_runs import (
    DEPTH_DISTORTION,
    INSTANCES,
    MESH,
    METRICS,
    PARTIAL_METRICS,
    POSE_GRAPH,
    TRACKED_TRAJECTORY,
    TRAJECTORY,
    Record,
    is_number,
    read_partial,
    read_record,
)
from framework.runs.timings_file import HEADER_SIZE, StageTimes, read_timings
from framework.runtime.run_log import FUSION, FUSION_STAGES
from framework.sensors.depth_distortion import DepthDistortion


@dataclass(frozen=True)
class RunContents:
    """The outputs of a run. Missing outputs are None or empty."""

    record: Record
    partial: str  # reason for the early end of the run, "" = complete run
    mesh: InstanceMesh | None
    objects: tuple[StoredInstance, ...]  # sorted by id
    timestamps: Float64  # (P,) s, of the mapped frames
    poses: Float64  # (P, 4, 4) T_world_camera
    times: StageTimes | None
    tracked_positions: Float64 | None  # (P, 3) m, camera positions before any correction
    graph: SubmapGraph | None  # pose graph of the back end
    depth_distortion: DepthDistortion | None  # correction of depth

    @classmethod
    def read(cls, directory: Path) -> RunContents:
        """Read the outputs of a run.

        Raises:
            DataError: The run is missing, a file is damaged, or the files belong to different runs.
        """
        finish_replacement(directory)
        if path_exists(directory / METRICS):
            record, partial = read_record(directory), ""
        elif path_exists(directory / PARTIAL_METRICS):
            record, partial = read_partial(directory)
        else:
            raise DataError(f"{directory}: expected a run directory with {METRICS} or {PARTIAL_METRICS}, got neither")
        mesh, objects = _map_of(record)
        timestamps, poses = np.zeros(0), np.zeros((0, 4, 4))
        if path_exists(directory / TRAJECTORY):
            timestamps, poses = read_tum(directory / TRAJECTORY)
        before = directory / TRACKED_TRAJECTORY
        tracked = read_tum(before)[1][:, :3, 3] if path_exists(before) else None
        if tracked is not None and len(tracked) != len(poses):
            raise DataError(
                f"{before}: expected {len(poses)} poses, as in {TRAJECTORY}, got {len(tracked)}; repeat the run"
            )
        timings = directory / "timings.csv"
        return cls(
            record,
            partial,
            mesh if mesh is not None and len(mesh.triangles) else None,
            tuple(sorted(objects, key=lambda one: one.id)),
            timestamps,
            poses,
            read_timings(timings) if path_exists(timings) and check_regular(timings).st_size > HEADER_SIZE else None,
            tracked,
            read_pose_graph(directory / POSE_GRAPH),
            read_depth_distortion(directory / DEPTH_DISTORTION),
        )

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return str(self.record.metrics.get("sequence") or self.record.directory.resolve().name)

    @property
    def up(self) -> Float64 | None:
        """Up direction (3,), a unit vector in the world frame, or None if unknown."""
        values = [self.record.metrics.get(f"map.up.{axis}") for axis in "xyz"]
        up = np.array([value if is_number(value) else np.nan for value in values], np.float64)
        length = np.linalg.norm(up)
        return np.asarray(up / length) if abs(length - 1) < UNIT_TOLERANCE else None  # false for NaN

    @cached_property
    def viewpoints(self) -> Float64:
        """Camera poses (N, 4, 4) with views of the map: `poses`, or virtual poses for an imported map with a mesh."""
        if self.mesh is not None and self.record.is_imported:
            return surrounding_poses(self.mesh.vertices, self.up)
        return self.poses

    @property
    def tracked_frames(self) -> tuple[int, ...]:
        """Frame numbers of `poses`, empty if unknown."""
        if self.times is None:
            return ()
        milliseconds = self.times.milliseconds
        fused = [milliseconds[stage] for stage in (*FUSION_STAGES, FUSION) if stage in milliseconds]
        numbers = self.times.frames[np.isfinite(fused).any(axis=0)].tolist() if fused else []
        return tuple(numbers) if len(numbers) == len(self.poses) else ()

    @property
    def frame_numbers(self) -> tuple[int, ...]:
        """Frame numbers of `poses`, counted from 0 if unknown."""
        return self.tracked_frames or tuple(range(len(self.poses)))

    @property
    def lost_frames(self) -> tuple[int, ...]:
        """Numbers of the frames without a pose, empty if unknown."""
        if self.times is None or not self.tracked_frames:
            return ()
        return tuple(np.setdiff1d(self.times.frames, self.tracked_frames).tolist())

    @property
    def lost_after(self) -> list[int]:
        """Index in `poses` of the last pose before each gap of lost frames."""
        before = np.searchsorted(self.tracked_frames, self.lost_frames) - 1
        return sorted({max(0, int(k)) for k in before})

    def instance_ids(self, mesh: InstanceMesh) -> Int32:
        """Return the object id (V,) of each vertex of a mesh.

        The id is 0 for vertices without an object in instances.json.
        """
        listed = np.isin(mesh.instance_ids, [one.id for one in self.objects])
        return np.where(listed, mesh.instance_ids, 0).astype(np.int32)


def _map_of(record: Record) -> tuple[InstanceMesh | None, list[StoredInstance]]:
    mesh, instances = record.directory / MESH, record.directory / INSTANCES
    if path_exists(mesh) and path_exists(instances):
        return read_objects(record)
    return read_mesh(mesh) if path_exists(mesh) else None, read_instances(instances) if path_exists(instances) else []
