"""The map's objects as a JSON list, and what the evaluation needs of them read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from framework.data import Box, Float32, Instance, InstanceMesh
from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.records.metrics import class_name

LARGEST_ID = 2**31 - 1


@dataclass(frozen=True)
class StoredInstance:
    """What instances.json says of one object, as far as it is evaluated."""

    id: int  # 1 to LARGEST_ID
    class_name: str
    confidence: float  # in [0, 1]
    vertices: int  # of the mesh
    probability: float | None = None  # of that class, in [0, 1]; None = the file does not tell


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
        raise DataError(f"{where}: expected an object with id, class, confidence and vertices, found {entry!r:.40}")
    name, probabilities = _string(where, entry, "class"), entry.get("class_probabilities")
    likely = None
    if isinstance(probabilities, dict) and name in probabilities:
        likely = _fraction(f"{where}, class_probabilities", probabilities, name)
    return StoredInstance(
        id=_integer(where, entry, "id", 1),
        class_name=name,
        confidence=_fraction(where, entry, "confidence"),
        vertices=_integer(where, entry, "vertices", 0),
        probability=likely,
    )


def _integer(where: str, entry: Mapping[str, Any], key: str, lowest: int) -> int:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= LARGEST_ID:
        raise DataError(f"{where}: {key} must be a whole number from {lowest} to {LARGEST_ID}, found {value!r:.40}")
    return value


def _string(where: str, entry: Mapping[str, Any], key: str) -> str:
    value = entry.get(key)
    if not isinstance(value, str):
        raise DataError(f"{where}: {key} must be a name, found {value!r:.40}")
    return value


def _fraction(where: str, entry: Mapping[str, Any], key: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:  # NaN is neither
        raise DataError(f"{where}: {key} must be a number in [0, 1], found {value!r:.40}")
    return float(value)


def _shortest(values: Float32) -> list[float]:
    """With the fewest digits that give each float32 back: 0.9, not 0.8999999761581421."""
    return [float(str(value)) for value in values]


def _box(box: Box) -> dict[str, list[float] | list[list[float]]]:
    return {"center": box.center.tolist(), "extent": box.extent.tolist(), "rotation": box.rotation.tolist()}
