"""Reading and writing of instances.json, the instances of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Box, Float64, Instance, InstanceMesh
from framework.errors import DataError
from framework.files.json_file import read_json, write_json
from framework.files.manifest import verified
from framework.runs.metrics import class_name
from framework.runtime.plain_output import plain

LARGEST_ID = 2**31 - 1
FARTHEST = 1e6  # m, maximum coordinate and size; float32 has a resolution of 6 cm there
NO_CLASS = "object"  # class name in a map without classes


@dataclass(frozen=True)
class StoredInstance:
    """An instance in instances.json. Coordinates are in m, in the world frame.

    Control characters in class names are escaped.
    """

    id: int  # 1 to LARGEST_ID
    class_name: str  # NO_CLASS in a map without classes
    confidence: float  # in [0, 1]
    class_probabilities: Mapping[str, float]  # each in [0, 1]
    observations: int  # number of frames with a detection
    first_frame: int  # Frame.index of the first detection
    last_frame: int
    vertices: int  # number of mesh vertices
    centroid: Float64 | None  # (3,) of its vertices; None = no vertices
    obb: Box
    exists: float | None = None  # probability that it exists; None = not calibrated
    class_probability: float | None = None  # probability that its class is right, if it exists
    expected_iou: float | None = None  # expected IoU with the object, if it exists

    @property
    def existence(self) -> float:
        """Probability that it exists, or its confidence if it is not calibrated."""
        return self.confidence if self.exists is None else self.exists

    @property
    def probabilities(self) -> tuple[float, float]:
        """The probabilities that it exists and that its class is right, as `Instance.probabilities`."""
        largest = max(self.class_probabilities.values(), default=0.0)
        return self.existence, largest if self.class_probability is None else self.class_probability

    @property
    def probability(self) -> float | None:
        """Probability of `class_name`, or None if unknown."""
        return self.class_probabilities.get(self.class_name)


def write_instances(
    path: Path, mesh: InstanceMesh, instances: Mapping[int, Instance], classes: tuple[str, ...]
) -> None:
    """Write the instances sorted by id. Lengths are in m."""
    write_json(
        path,
        [
            {
                "id": instance.id,
                "class": class_name(instance, classes),
                "confidence": float(instance.confidence),  # not rounded, to avoid equal values
                "exists": instance.exists,
                "class_probability": instance.class_probability,
                "expected_iou": instance.expected_iou,
                # shortest decimal form of each float32: 0.9, not 0.8999999761581421
                "class_probabilities": {
                    name: float(str(value)) for name, value in zip(classes, instance.class_probabilities, strict=True)
                },
                "observations": int(instance.observations),
                "first_frame": int(instance.first_frame),
                "last_frame": int(instance.last_frame),
                "centroid": mesh.vertices[instance.vertices].mean(axis=0).tolist() if len(instance.vertices) else None,
                "aabb": {
                    "min": (instance.aabb.center - instance.aabb.extent / 2).tolist(),
                    "max": (instance.aabb.center + instance.aabb.extent / 2).tolist(),
                },
                "obb": {name: getattr(instance.obb, name).tolist() for name in ("center", "extent", "rotation")},
                "vertices": len(instance.vertices),
            }
            for _, instance in sorted(instances.items())
        ],
    )


def read_instances(path: Path) -> list[StoredInstance]:
    """Read the instances that were written by `write_instances`.

    Raises:
        DataError: The file is missing or invalid.
    """
    with verified(path):
        entries = read_json(path)
    if not isinstance(entries, list):
        raise DataError(f"{path}: expected a JSON array of instances, got {entries!r:.40}")
    found = [_stored(f"{path}, entry {number}", entry) for number, entry in enumerate(entries, start=1)]
    ids = {instance.id for instance in found}
    if len(ids) < len(found):
        raise DataError(f"{path}: expected unique ids, got {len(ids)} ids for {len(found)} instances")
    return found


def _stored(where: str, entry: Any) -> StoredInstance:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected a JSON object with the keys of instances.schema.json, got {entry!r:.40}")
    box, probabilities = entry.get("obb"), entry.get("class_probabilities")
    if not isinstance(box, dict) or not isinstance(probabilities, dict):
        raise DataError(
            f"{where}: expected JSON objects in obb and class_probabilities, got {box!r:.40} and {probabilities!r:.40}"
        )
    return StoredInstance(
        id=_integer(where, entry, "id", 1),
        class_name=_class(where, entry),
        confidence=_fraction(where, entry, "confidence"),
        class_probabilities={
            plain(name): _fraction(f"{where}, class_probabilities", probabilities, name) for name in probabilities
        },
        observations=_integer(where, entry, "observations", 0),
        first_frame=_integer(where, entry, "first_frame"),
        last_frame=_integer(where, entry, "last_frame"),
        vertices=_integer(where, entry, "vertices", 0),
        centroid=None if entry.get("centroid") is None else _array(where, entry, "centroid", (3,)),
        obb=Box(
            center=_array(where, box, "center", (3,)),
            extent=_array(where, box, "extent", (3,)),
            rotation=_array(where, box, "rotation", (3, 3)),
        ),
        **{
            name: None if entry.get(name) is None else _fraction(where, entry, name)  # older files lack them
            for name in ("exists", "class_probability", "expected_iou")
        },
    )


def _integer(where: str, entry: Mapping[str, Any], key: str, lowest: int | None = None) -> int:
    """Return an integer in [`lowest`, LARGEST_ID], or any integer without `lowest`."""
    value = entry.get(key)
    if isinstance(value, int) and not isinstance(value, bool) and (lowest is None or lowest <= value <= LARGEST_ID):
        return value
    limits = "" if lowest is None else f" in [{lowest}, {LARGEST_ID}]"
    raise DataError(f"{where}: {key}: expected an integer{limits}, got {value!r:.40}")


def _class(where: str, entry: Mapping[str, Any]) -> str:
    value = entry.get("class", ...)
    if value is not None and not isinstance(value, str):
        got = "no class" if value is ... else repr(value)
        raise DataError(f"{where}: class: expected a name or null, got {got:.40}")
    return NO_CLASS if value is None else plain(value)


def _fraction(where: str, entry: Mapping[str, Any], key: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:  # rejects NaN
        raise DataError(f"{where}: {key:.40}: expected a number in [0, 1], got {value!r:.40}")
    return float(value)


def _array(where: str, entry: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Float64:
    try:
        values = np.array(entry.get(key), np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != shape or not (np.abs(values) <= FARTHEST).all():  # rejects NaN
        raise DataError(
            f"{where}: {key}: expected numbers of shape {shape} in [{-FARTHEST:g}, {FARTHEST:g}], got "
            f"{entry.get(key)!r:.60}"
        )
    return values
