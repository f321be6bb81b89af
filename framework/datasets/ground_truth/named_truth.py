"""The ground truth set by `dataset.ground_truth`: a labeled mesh or the map of a run.

    DIR/mesh.ply            a PLY file of any name: vertex x y z [m], integer property `instance`, 0 = none; faces
    DIR/instances.json      next to the mesh or in the parent folder: {"<id>": {"name", "class"}}; class = a COCO name
                            or another name, null = unknown
    RUN/                    a run directory: mesh.ply, instances.json (a list) and trajectory.txt

A labeled mesh is in the world frame of the recording's poses. The map of a run is in the world frame of the estimated
trajectory.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Float64, Int32, ReferenceTrajectory
from framework.datasets.frames.world_offset import origin_comments
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.errors import ConfigError, DataError
from framework.files.atomic_write import path_exists
from framework.files.folders.staged_files import finish_replacement
from framework.files.json_file import read_json
from framework.files.manifest import verified
from framework.files.ply import PlyMesh, found_property, read_ply
from framework.files.search_paths import candidates
from framework.files.tum_trajectory import read_tum
from framework.geometry import FARTHEST
from framework.vocabulary.label_spaces import COCO, LONGEST_CLASS_NAME, MEANINGS, with_similar

KEY = "dataset.ground_truth"
MESH, INSTANCES, TRAJECTORY, METRICS = "mesh.ply", "instances.json", "trajectory.txt", "metrics.json"  # run outputs
LABELS = "instance"  # name of the vertex property
LARGEST_ID = np.iinfo(np.int32).max
MAX_DIGITS = 10  # maximum number of digits of an id, including leading zeros

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NamedTruth:
    """A ground-truth mesh, with the trajectory of the run if the mesh is the map of a run."""

    mesh: LabeledMesh
    name: str  # for tables: the file and its folder
    trajectory: ReferenceTrajectory | None  # None = the mesh is in the world frame of the given poses

    def pose(self, timestamp: float, given: Float64 | None) -> Float64 | None:
        """Return the pose T_world_camera (4, 4) of a frame in the world frame of the mesh, or None if unknown.

        Args:
            timestamp: The timestamp of the frame, s.
            given: The pose (4, 4) of the frame in the recording.
        """
        if self.trajectory is None:
            return given
        k = int(self.trajectory.at(np.array([timestamp]))[0])
        return self.trajectory.T_world_camera[k] if k >= 0 else None


def read_named_truth(path: Path, origin: Sequence[float] = ()) -> NamedTruth:
    """Read the ground truth in a run directory or a labeled mesh.

    Args:
        path: The run directory or the mesh.
        origin: Origin of the mapped world frame in the world frame of the recording (3,), m; () = 0. It is subtracted
            from a mesh in the world frame of the recording.

    Raises:
        ConfigError: The path does not exist.
        DataError: A file is missing or invalid.
    """
    files = truth_files(path)
    mesh, names = files[0], files[1]
    with verified(mesh), verified(names):
        ply, content = read_ply(mesh), read_json(names)
    ids = _labels_of(mesh, ply)
    label = f"{mesh.parent.name}/{mesh.name}"
    if isinstance(content, list):
        class_names = _classes_of_run(names, content)
        ids = np.where(np.isin(ids, list(class_names)), ids, 0).astype(np.int32)  # tentative instances have no entry
        return NamedTruth(_labeled(mesh, ply, ids, class_names), label, _trajectory_of_run(mesh.parent))
    if origin and not _is_in_map_world(ply, origin):
        ply = read_ply(mesh, origin)
    class_names = read_class_names(names, LARGEST_ID)
    unlisted = set(np.unique(ids).tolist()) - class_names.keys() - {0}
    if unlisted:
        raise DataError(
            f"{names}: expected an entry for each instance of {mesh.name}, got none for instance {min(unlisted)}"
        )
    return NamedTruth(_labeled(mesh, ply, ids, class_names), label, None)


def _is_in_map_world(ply: PlyMesh, origin: Sequence[float]) -> bool:
    """Return True if the origin (3,) is already subtracted from a mesh: by its comments, or by its distance."""
    if set(origin_comments(origin)) & set(ply.comments):
        return True
    distance = np.linalg.norm(np.median(ply.vertices, axis=0))
    return bool(distance <= FARTHEST < np.linalg.norm(origin))


def truth_files(path: Path) -> list[Path]:
    """Return the ground-truth files: the mesh, its instances.json and, for a run, the trajectory.

    Raises:
        ConfigError: The path does not exist.
        DataError: A file is missing.
    """
    found = next((place for place in candidates(path) if place.exists()), None)
    if found is None:
        raise ConfigError(f"{KEY}: expected a labeled mesh (PLY) or a run directory, got the nonexistent path {path}")
    mesh = found / MESH if found.is_dir() else found
    finish_replacement(mesh.parent)
    if not path_exists(mesh):
        raise DataError(f"{KEY}: expected {MESH} in the directory {found}, got none; set {KEY} to the labeled mesh")
    places = [mesh.with_name(INSTANCES), mesh.absolute().parents[1] / INSTANCES]
    names = next((place for place in places if path_exists(place)), None)
    if names is None:
        raise DataError(f"{KEY}: expected {places[0]} with the class of each instance of {mesh.name}, got none")
    trajectory = mesh.with_name(TRAJECTORY)
    return [mesh, names, trajectory] if path_exists(trajectory) else [mesh, names]


def read_class_names(path: Path, largest_id: int) -> dict[int, str | None]:
    """Read the class of each instance id in the instances.json of a labeled mesh.

    An unknown class is None.

    Raises:
        DataError: The file is invalid or contains an id above `largest_id`.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected a JSON object, got {type(content).__name__}")
    class_names: dict[int, str | None] = {}
    for key, entry in content.items():
        if not (key.isascii() and key.isdigit() and len(key) <= MAX_DIGITS and 0 < int(key) <= largest_id):
            raise DataError(f"{path}: expected instance ids from 1 to {largest_id}, got {key!r:.60}")
        if int(key) in class_names:
            raise DataError(f"{path}: expected unique instance ids, got {int(key)} twice, the second time as {key!r}")
        class_names[int(key)] = _class_of(f"{path}: instance {key}", entry)
    if own := sorted({name for name in class_names.values() if name is not None} - set(COCO)):
        log.info("%s: classes outside of COCO: %s", path, ", ".join(map(with_similar, own)))
    return class_names


def _class_of(where: str, entry: Any) -> str | None:
    if not isinstance(entry, dict) or "class" not in entry:
        expected = 'a JSON object with the key "class" (a name, or null if unknown)'
        raise DataError(f"{where}: expected {expected}, got {entry!r:.60}")
    name = entry["class"]
    if name is None:
        return None
    if not isinstance(name, str) or name != name.strip() or not 0 < len(name) <= LONGEST_CLASS_NAME:
        expected = f"a name of at most {LONGEST_CLASS_NAME} characters without outer spaces, or null if unknown"
        raise DataError(f"{where}: class: expected {expected}, got {name!r:.60}")
    coco = MEANINGS.get(name.lower())
    if coco not in (None, name):
        raise DataError(f"{where}: class: expected the COCO name {coco!r}, got {name!r}; rename the class")
    return name


def _labels_of(path: Path, ply: PlyMesh) -> Int32:
    """Return the instance ids (V,) of the vertices."""
    labels = ply.properties.get(LABELS)
    if labels is None or labels.dtype.kind not in "iu":
        found = found_property(ply, labels)
        raise DataError(f"{path}: expected an integer vertex property {LABELS!r}, got {found}; label the mesh")
    if not len(ply.triangles):
        raise DataError(f"{path}: expected faces to render masks from, got none; set {KEY} to a mesh with faces")
    if int(labels.min()) < 0 or int(labels.max()) > LARGEST_ID:
        raise DataError(f"{path}: {LABELS}: expected values in [0, {LARGEST_ID}], got {labels.min()} to {labels.max()}")
    return labels.astype(np.int32)


def _labeled(path: Path, ply: PlyMesh, ids: Int32, class_names: Mapping[int, str | None]) -> LabeledMesh:
    if not ids.any():
        raise DataError(f"{path}: expected vertices with an instance, got only instance 0; label the mesh")
    return LabeledMesh(ply.vertices, ply.triangles, ids, class_names)


def _classes_of_run(path: Path, entries: Sequence[Any]) -> dict[int, str | None]:
    """Return the class of each instance in the instances.json of a run.

    The classes are None if the map has no classes.
    """
    class_names: dict[int, str | None] = {}
    for number, entry in enumerate(entries, start=1):
        key, name = (entry.get("id"), entry.get("class", ...)) if isinstance(entry, dict) else (None, None)
        if type(key) is not int or not 0 < key <= LARGEST_ID or not (name is None or isinstance(name, str)):
            expected = "expected a JSON object with an id and a class"
            raise DataError(f"{path}, entry {number}: {expected}, got {entry!r:.60}; repeat the run")
        class_names[key] = name
    return class_names


def _trajectory_of_run(directory: Path) -> ReferenceTrajectory:
    timestamps, poses = read_tum(directory / TRAJECTORY)
    with verified(directory / METRICS):
        metrics = read_json(directory / METRICS) if path_exists(directory / METRICS) else {}
    given = isinstance(metrics, dict) and metrics.get("pose_source") == "ground_truth"
    return ReferenceTrajectory(timestamps, poses, given)
