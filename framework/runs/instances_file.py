"""The map's objects as a JSON list, and read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Box, Float32, Float64, Instance, InstanceMesh
from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.runs.metrics import class_name

LARGEST_ID = 2**31 - 1
FARTHEST = 1e6  # m, of places and sizes; mesh.ply has no finer steps than 6 cm there
NO_CLASS = "object"  # what an object of a map without classes is called


@dataclass(frozen=True)
class StoredInstance:
    """One object, as instances.json tells it; lengths in m, in the world."""

    id: int  # 1 to LARGEST_ID
    class_name: str  # NO_CLASS where the map knows no classes
    confidence: float  # in [0, 1]
    class_probabilities: Mapping[str, float]  # each in [0, 1]
    observations: int  # frames in which it was detected
    first_frame: int  # whatever number its source gave it
    last_frame: int
    vertices: int  # of the mesh
    centroid: Float64 | None  # (3,) of its vertices; None = it has none
    obb: Box

    @property
    def probability(self) -> float | None:
        """Of its class; None = the file does not tell."""
        return self.class_probabilities.get(self.class_name)


def write_instances(
    path: Path, mesh: InstanceMesh, instances: Mapping[int, Instance], classes: tuple[str, ...]
) -> None:
    """Writes the objects as a list, by id. `vertices` is how many of the mesh's vertices carry the id; lengths in m.

    Confidences and probabilities have all their digits: rounded ones could tie, and then rank or name objects anew.
    """
    write_json(
        path,
        [
            {
                "id": instance.id,
                "class": class_name(instance, classes),
                "confidence": float(instance.confidence),
                "class_probabilities": dict(zip(classes, _shortest(instance.class_probabilities), strict=True)),
                "observations": int(instance.observations),
                "first_frame": int(instance.first_frame),
                "last_frame": int(instance.last_frame),
                "centroid": mesh.vertices[instance.vertices].mean(axis=0).tolist() if len(instance.vertices) else None,
                "aabb": {
                    "min": (instance.aabb.center - instance.aabb.extent / 2).tolist(),
                    "max": (instance.aabb.center + instance.aabb.extent / 2).tolist(),
                },
                "obb": _box(instance.obb),
                "vertices": len(instance.vertices),
            }
            for _, instance in sorted(instances.items())
        ],
    )


def read_instances(path: Path) -> list[StoredInstance]:
    """The objects that `write_instances` wrote. Raises DataError, naming the file and the entry, for anything else."""
    entries = read_json(path)
    if not isinstance(entries, list):
        raise DataError(f"{path} must hold a list of instances, found {type(entries).__name__}")
    found = [_stored(f"{path}, entry {number}", entry) for number, entry in enumerate(entries, start=1)]
    ids = {instance.id for instance in found}
    if len(ids) < len(found):
        raise DataError(f"{path} lists {len(found)} instances with {len(ids)} different ids; each must have its own")
    return found


def _stored(where: str, entry: Any) -> StoredInstance:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected an object with id, class, confidence and so on, found {entry!r:.40}")
    box, probabilities = entry.get("obb"), entry.get("class_probabilities")
    if not isinstance(box, dict) or not isinstance(probabilities, dict):
        raise DataError(f"{where}: expected obb and class_probabilities with keys and values")
    return StoredInstance(
        id=_integer(where, entry, "id", 1),
        class_name=_class(where, entry),
        confidence=_fraction(where, entry, "confidence"),
        class_probabilities={
            name: _fraction(f"{where}, class_probabilities", probabilities, name) for name in probabilities
        },
        observations=_integer(where, entry, "observations", 0),
        first_frame=_whole(where, entry, "first_frame"),
        last_frame=_whole(where, entry, "last_frame"),
        vertices=_integer(where, entry, "vertices", 0),
        centroid=None if entry.get("centroid") is None else _array(where, entry, "centroid", (3,)),
        obb=Box(
            center=_array(where, box, "center", (3,)),
            extent=_array(where, box, "extent", (3,)),
            rotation=_array(where, box, "rotation", (3, 3)),
        ),
    )


def _integer(where: str, entry: Mapping[str, Any], key: str, lowest: int) -> int:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= LARGEST_ID:
        raise DataError(f"{where}: {key} must be a whole number from {lowest} to {LARGEST_ID}, found {value!r:.40}")
    return value


def _whole(where: str, entry: Mapping[str, Any], key: str) -> int:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise DataError(f"{where}: {key} must be a whole number, found {value!r:.40}")
    return value


def _class(where: str, entry: Mapping[str, Any]) -> str:
    value = entry.get("class", ...)
    if value is not None and not isinstance(value, str):
        raise DataError(f"{where}: class must be a name, or null, found {entry.get('class', 'no class')!r:.40}")
    return NO_CLASS if value is None else value


def _fraction(where: str, entry: Mapping[str, Any], key: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:  # NaN is neither
        raise DataError(f"{where}: {key:.40} must be a number in [0, 1], found {value!r:.40}")
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


def _shortest(values: Float32) -> list[float]:
    """With the fewest digits that give each float32 back: 0.9, not 0.8999999761581421."""
    return [float(str(value)) for value in values]


def _box(box: Box) -> dict[str, list[float] | list[list[float]]]:
    return {"center": box.center.tolist(), "extent": box.extent.tolist(), "rotation": box.rotation.tolist()}
