"""What a run left behind, read for its report: all of a complete record, of a partial one what there is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import UNIT_TOLERANCE, Float64, InstanceMesh, Int32
from framework.errors import DataError
from framework.files.json_file import read_json
from framework.files.tum_trajectory import read_tum
from framework.files.whole_files import is_there
from framework.records.mesh_file import read_mesh
from framework.records.stored_map import read_objects
from framework.records.stored_runs import (
    METRICS,
    PARTIAL_METRICS,
    TRAJECTORY,
    Record,
    is_number,
    read_partial,
    read_record,
)
from framework.records.timings_file import StageTimes, read_timings

FARTHEST = 1e6  # m, of places and sizes; mesh.ply has no finer steps than 6 cm there
LIKELY_CLASSES = 6  # of an object's class distribution, that a page shows


@dataclass(frozen=True)
class MappedObject:
    """One object, as instances.json tells it."""

    id: int
    class_name: str
    confidence: float  # in [0, 1]
    class_probabilities: tuple[tuple[str, float], ...]  # the likeliest, best first
    observations: int  # frames in which it was detected
    first_frame: int
    last_frame: int
    vertices: int
    centroid: Float64 | None  # (3,) m, world, of its vertices; None = it has none
    center: Float64  # (3,) m, world, of its oriented box
    extent: Float64  # (3,) m
    rotation: Float64  # (3, 3) the box's axes as columns


@dataclass(frozen=True)
class RunContents:
    """A run's record. What is None is not there."""

    record: Record
    partial: str  # why the run ended early, "" = it completed
    mesh: InstanceMesh | None
    objects: tuple[MappedObject, ...]  # by id
    timestamps: Float64  # (P,) s, of the frames that were mapped
    poses: Float64  # (P, 4, 4) T_world_camera
    times: StageTimes | None

    @classmethod
    def read(cls, directory: Path) -> RunContents:
        """Raises DataError, naming the file, when there is no record, or a file of it is damaged or of another run."""
        if is_there(directory / METRICS):
            record, partial = read_record(directory), ""
        elif is_there(directory / PARTIAL_METRICS):
            record, partial = read_partial(directory)
        else:
            raise DataError(f"{directory} holds no run: neither {METRICS} nor {PARTIAL_METRICS} is there")
        instances, mesh_path = directory / "instances.json", directory / "mesh.ply"
        mesh = None
        if is_there(mesh_path):
            mesh = read_objects(record)[0] if is_there(instances) else read_mesh(mesh_path)
        timestamps, poses = np.zeros(0), np.zeros((0, 4, 4))
        if is_there(directory / TRAJECTORY):
            timestamps, poses = read_tum(directory / TRAJECTORY)
        timings = directory / "timings.csv"
        return cls(
            record,
            partial,
            mesh if mesh is not None and len(mesh.triangles) else None,
            tuple(_objects(instances)) if is_there(instances) else (),
            timestamps,
            poses,
            read_timings(timings) if is_there(timings) and timings.stat().st_size > len(_NO_TIMES) else None,
        )

    @property
    def name(self) -> str:
        """Of what was mapped."""
        return str(self.record.metrics.get("sequence") or self.record.directory.resolve().name)

    @property
    def up(self) -> Float64 | None:
        """(3,) against gravity, None where the map does not tell."""
        values = [self.record.metrics.get(f"map.up.{axis}") for axis in "xyz"]
        up = np.array([value if is_number(value) else np.nan for value in values], np.float64)
        length = np.linalg.norm(up)
        return np.asarray(up / length) if abs(length - 1) < UNIT_TOLERANCE else None  # NaN is not

    @property
    def tracked_frames(self) -> tuple[int, ...]:
        """The numbers of the frames that `poses` are of; empty where the times do not tell."""
        if self.times is None or "fuse" not in self.times.milliseconds:
            return ()
        numbers = self.times.frames[np.isfinite(self.times.milliseconds["fuse"])].tolist()
        return tuple(numbers) if len(numbers) == len(self.poses) else ()

    @property
    def lost_frames(self) -> tuple[int, ...]:
        """The numbers of the frames whose pose was not known."""
        if self.times is None or not self.tracked_frames:
            return ()
        return tuple(np.setdiff1d(self.times.frames, self.tracked_frames).tolist())

    def instance_ids(self, mesh: InstanceMesh) -> Int32:
        """(V,) of the mesh's vertices, 0 = of no object that is listed."""
        listed = np.isin(mesh.instance_ids, [one.id for one in self.objects])
        return np.where(listed, mesh.instance_ids, 0).astype(np.int32)


_NO_TIMES = "frame,stage,milliseconds\n"


def _objects(path: Path) -> list[MappedObject]:
    entries = read_json(path)
    if not isinstance(entries, list):
        raise DataError(f"{path} must hold a list of instances, found {type(entries).__name__}")
    found = [_object(f"{path}, entry {number}", entry) for number, entry in enumerate(entries, start=1)]
    return sorted(found, key=lambda one: one.id)


def _object(where: str, entry: Any) -> MappedObject:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected an object, found {entry!r:.40}")
    box, probabilities = entry.get("obb"), entry.get("class_probabilities")
    if not isinstance(box, dict) or not isinstance(probabilities, dict):
        raise DataError(f"{where}: expected obb and class_probabilities with keys and values")
    named = [(str(name), _number(where, probabilities, name)) for name in probabilities]
    name = entry.get("class")
    return MappedObject(
        id=_whole(where, entry, "id"),
        class_name=name if isinstance(name, str) else "object",
        confidence=_number(where, entry, "confidence"),
        class_probabilities=tuple(sorted(named, key=lambda one: (-one[1], one[0]))[:LIKELY_CLASSES]),
        observations=_whole(where, entry, "observations"),
        first_frame=_whole(where, entry, "first_frame"),
        last_frame=_whole(where, entry, "last_frame"),
        vertices=_whole(where, entry, "vertices"),
        centroid=_array(where, entry, "centroid", (3,)) if entry.get("centroid") is not None else None,
        center=_array(where, box, "center", (3,)),
        extent=_array(where, box, "extent", (3,)),
        rotation=_array(where, box, "rotation", (3, 3)),
    )


def _whole(where: str, entry: Mapping[str, Any], key: str) -> int:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise DataError(f"{where}: {key} must be a whole number, found {value!r:.40}")
    return value


def _number(where: str, entry: Mapping[str, Any], key: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"{where}: {key:.40} must be a number, found {value!r:.40}")
    return float(value)


def _array(where: str, entry: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Float64:
    try:
        values = np.array(entry.get(key), np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != shape or not (np.abs(values) <= FARTHEST).all():  # NaN is not
        raise DataError(
            f"{where}: {key} must hold numbers of shape {shape}, up to {FARTHEST:g}, found {entry.get(key)!r:.60}"
        )
    return values
