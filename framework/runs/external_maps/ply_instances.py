"""Instances in the vertex or face properties of a PLY file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from framework.data import Int32, Int64
from framework.errors import DataError
from framework.files.ply import PlyMesh
from framework.mapping.instances.instance_list import vertices_by_id
from framework.runs.external_maps.class_labels import ClassIdNames, InstanceLabel, class_of_id
from framework.runs.external_maps.external_map import ExternalInstance, ExternalMap

INSTANCE_NAMES = ("instance", "instance_id", "instanceid", "object_id", "objectid", "object", "inst", "instance_label")
CLASS_NAMES = ("class", "class_id", "classid", "semantic", "semantic_id", "semantic_label", "category", "label")
"""Common names of the properties, in lower case and in order of preference."""

LARGEST_ID = 2**31 - 2


@dataclass(frozen=True)
class LabelProperties:
    """The names of the properties with the labels."""

    instance: str | None = None  # instance ids; None = detected by name
    class_: str | None = None  # class ids; None = detected by name; "" = no classes
    no_instance: int = 0  # id of points without an instance


def read_ply_instances(
    path: Path,
    surface: PlyMesh,
    chosen: LabelProperties,
    names: ClassIdNames | None,
    labels: Mapping[int, InstanceLabel] | None,
) -> ExternalMap:
    """Return the map in a labeled PLY file.

    The class of an instance is that of most of its vertices. A property of faces is transferred to their vertices.

    Args:
        path: The PLY file, for messages.
        surface: The content of the file.
        chosen: The names of the properties.
        names: The names of the class ids; None = unknown.
        labels: The class and confidence of each instance id, instead of the class property. Instances without an entry
            are left out; None = no labels.

    Raises:
        DataError: A property is missing or invalid, or a class id has no name.
    """
    properties = _properties(surface)
    instance_name = _found(path, properties, chosen.instance, INSTANCE_NAMES, "instance_property")
    if instance_name is None:
        raise DataError(
            f"{path}: expected a property with instance ids ({', '.join(INSTANCE_NAMES[:4])}, ...), got only "
            f"{', '.join(properties) or 'coordinates'}; set instance_property, or set labels to ScanNet predictions or "
            "a mask folder"
        )
    ids, offset = _ids(path, instance_name, properties[instance_name], chosen.no_instance)
    members = {key - offset: vertices for key, vertices in vertices_by_id(ids).items()}
    if labels is not None:
        found = {key: labels[key] for key in members if key in labels}
        without = len(members) - len(found)
        source = f"instances: property {instance_name}; classes: labels"
        source += f", {without} of {len(members)} instances without an entry left out" if without else ""
    else:
        class_name = None
        if chosen.class_ != "":
            class_name = _found(path, properties, chosen.class_, CLASS_NAMES, "class_property")
        source = f"instances: property {instance_name}; classes: {f'property {class_name}' if class_name else 'none'}"
        found = dict.fromkeys(members, InstanceLabel(None, None))
        if class_name is not None:
            classes = _whole_numbers(path, class_name, properties[class_name])
            found = {key: InstanceLabel(_majority(path, classes[own], names), None) for key, own in members.items()}
    instances = {
        key + offset: ExternalInstance(members[key], label.name, label.confidence) for key, label in found.items()
    }
    return ExternalMap(surface, instances, source, () if names is None else names.all)


def _properties(surface: PlyMesh) -> dict[str, npt.NDArray[Any]]:
    """Return the properties (V,) of the vertices by name, including those of the faces of each vertex."""
    properties: dict[str, npt.NDArray[Any]] = {}
    for name, of_triangles in surface.triangle_properties.items():
        properties[name] = np.zeros(len(surface.vertices), of_triangles.dtype)
        properties[name][surface.triangles] = of_triangles[:, None]
    return properties | dict(surface.properties)


def _found(
    path: Path, properties: Mapping[str, Any], chosen: str | None, usual: Sequence[str], option: str
) -> str | None:
    """Return the name of the chosen or the first usual property; None = none of the usual properties."""
    if chosen is not None:
        if chosen not in properties:
            raise DataError(f"{path}: {option}: expected one of {', '.join(properties) or 'none'}, got {chosen}")
        return chosen
    by_lower_case = {name.lower(): name for name in properties}
    return next((by_lower_case[name] for name in usual if name in by_lower_case), None)


def _ids(path: Path, name: str, values: npt.NDArray[Any], no_instance: int) -> tuple[Int32, int]:
    """Return positive ids (V,), 0 = none, and the offset that was added to the ids of the file."""
    ids = _whole_numbers(path, name, values)
    is_instance = ids != no_instance
    lowest = int(ids[is_instance].min(initial=1))
    if lowest < 0:
        raise DataError(
            f"{path}: {name}: expected instance ids >= 0, and {no_instance} for no instance, got {lowest}; set "
            f"no_instance={lowest} if it means no instance"
        )
    offset = int(lowest == 0)
    if int(ids.max(initial=0)) > LARGEST_ID:
        raise DataError(f"{path}: {name}: expected instance ids of at most {LARGEST_ID}, got {ids.max()}")
    return np.where(is_instance, ids + offset, 0).astype(np.int32), offset


def _whole_numbers(path: Path, name: str, values: npt.NDArray[Any]) -> Int64:
    whole = values.astype(np.int64) if values.dtype.kind in "iu" else np.rint(values).astype(np.int64)
    if not np.array_equal(whole, values):
        raise DataError(f"{path}: {name}: expected integers, got fractions; set another property")
    return whole


def _majority(path: Path, class_ids: Int64, names: ClassIdNames | None) -> str:
    ids, counts = np.unique(class_ids, return_counts=True)
    return class_of_id(str(path), int(ids[counts.argmax()]), names)
