"""Conversion of maps from other systems to instance maps in the world frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.data import Float32, Float64, Instance, InstanceMesh, Int32, UInt8, check_rigid
from framework.errors import DataError
from framework.evaluation.compared_classes import listed
from framework.files.number_lines import read_matrix
from framework.files.ply import PlyMesh
from framework.geometry import transform
from framework.mapping.instances.instance_list import aligned_box, box_around
from framework.runs.external_maps.external_map import MAX_COORDINATE, UNLABELED, ExternalInstance, ExternalMap
from framework.vocabulary.label_spaces import (
    COCO,
    NO_CLASS,
    ClassNames,
    check_class_name,
    coco_name,
    keeps_names,
    reason_for_names,
)

GRAY = 180  # RGB value of surfaces without colors
NO_FRAME = -1  # first and last frame of an imported instance
CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class MapPlacement:
    """The transform from the coordinates of a file to the world frame, in meters."""

    scale: float = 1.0  # meters per unit of the file, > 0
    T_world_map: Float64 = field(default_factory=lambda: np.eye(4))  # (4, 4) from the scaled coordinates
    up: Float64 | None = None  # (3,) up direction in the world frame, a unit vector; None = unknown

    def __post_init__(self) -> None:
        if not 0 < self.scale < np.inf:
            raise DataError(f"scale: expected a positive number of meters per unit, got {self.scale}")
        check_rigid("transform", self.T_world_map)

    def placed(self, vertices: Float32) -> Float32:
        """Return points (V, 3) of the file in the world frame, m.

        Raises:
            DataError: A coordinate is too large.
        """
        points = transform(self.T_world_map, self.scale * vertices.astype(np.float64))
        if np.abs(points).max(initial=0) > MAX_COORDINATE:
            raise DataError(
                f"map: expected coordinates of at most {MAX_COORDINATE:g} m, got {np.abs(points).max():g} m; set "
                "scale to the number of meters per unit, or subtract an offset from coordinates such as UTM"
            )
        return points.astype(np.float32)


def read_transform(path: Path) -> Float64:
    """Read a rigid transform (4, 4) from a text file with four lines of four numbers.

    Raises:
        DataError: The file is invalid, or the transform is not rigid.
    """
    return read_matrix(path).pose()


@dataclass(frozen=True)
class ConvertedMap:
    """A map in the world frame, with COCO classes or the classes of its label space."""

    mesh: InstanceMesh  # a point cloud has no triangles
    instances: Mapping[int, Instance]
    remarks: tuple[str, ...]  # changes and assumptions, for the user

    @classmethod
    def of(
        cls, external: ExternalMap, placement: MapPlacement, class_names: ClassNames = ClassNames.AUTO
    ) -> ConvertedMap:
        """Convert the map of another system.

        Instances without a class are left out, except in a map without classes. At a point of several instances, the
        instance with the highest confidence is kept; of equal confidences, the one with the lowest id. An unknown
        confidence is 1. Class distributions are unknown, so the class of an instance has the probability 1.

        Args:
            external: The map.
            placement: The transform to the world frame.
            class_names: The kind of class names. AUTO considers the label space and the classes of all instances.

        Raises:
            DataError: No instance is left, or a class name or coordinate is invalid.
        """
        classes = MapClasses.of(external, class_names)
        kept = {key: one for key, one in external.instances.items() if classes.keeps(one)}
        remarks = [remark for remark in (classes.remark, classes.left_out(external)) if remark]
        if not kept:
            found = remarks[-1] if remarks else "no instances"
            fix = "" if classes.are_own else "; set class_names=OWN to keep all class names"
            raise DataError(f"map: expected an instance with {classes.described}, got none ({found}){fix}")
        if unknown := sum(one.confidence is None for one in kept.values()):
            remarks.append(f"confidence: unknown for {unknown} instances, set to 1; AP ranks equal confidences by id")
        vertices = placement.placed(external.surface.vertices)
        ids = _painted(len(vertices), kept)
        if overlapping := sum(len(one.vertices) for one in kept.values()) - int(np.count_nonzero(ids)):
            remarks.append(f"overlaps: removed {overlapping} labels at points of several instances")
        instances = {
            key: _instance(key, one, classes.distribution(one), vertices, ids, placement.up)
            for key, one in sorted(kept.items())
        }
        mesh = InstanceMesh(
            vertices=vertices,
            triangles=external.surface.triangles,
            colors=_colors(external.surface),
            instance_ids=ids,
            class_ids=_class_ids(ids, instances),
            classes=classes.names,
        )
        return cls(mesh, instances, tuple(remarks))


@dataclass(frozen=True)
class MapClasses:
    """The classes of a converted map."""

    names: tuple[str, ...]  # () = a map without classes
    are_own: bool  # True = names of the label space, False = COCO names
    remark: str = ""  # the reason for own names, "" without one

    @classmethod
    def of(cls, external: ExternalMap, class_names: ClassNames) -> MapClasses:
        """Return the classes of the map of another system.

        Raises:
            DataError: A class name is invalid.
        """
        found = [one.label for one in external.instances.values()]
        if all(label is None for label in found):
            return cls((), are_own=True)
        names = tuple(dict.fromkeys(filter(None, map(_class_name, (*external.label_space, *found)))))
        if not names or not keeps_names(names, class_names):
            return cls(COCO, are_own=False)
        for name in names:
            check_class_name("class", name)
        reason = reason_for_names(names) if class_names is ClassNames.AUTO else ""
        return cls(names, are_own=True, remark=f"classes: {reason}" if reason else "")

    @property
    def described(self) -> str:
        """Description of the classes, for messages."""
        return "a class" if self.are_own else "a COCO class"

    def name(self, instance: ExternalInstance) -> str | None:
        """Return the class of an instance, or None without one."""
        name = _class_name(instance.label)
        return name if self.are_own or name is None else coco_name(name)

    def keeps(self, instance: ExternalInstance) -> bool:
        """Return True if an instance is part of the map."""
        return not self.names or self.name(instance) is not None

    def left_out(self, external: ExternalMap) -> str:
        """Return a remark on the instances that are left out, "" without any."""
        instances = external.instances.values()
        counts = Counter(one.label or UNLABELED for one in instances if not self.keeps(one))
        if not counts:
            return ""
        left_out = f"{counts.total()} of {len(instances)} instances without {self.described}"
        return f"left out: {left_out}: {listed(counts)}"

    def distribution(self, instance: ExternalInstance) -> Float32:
        """Return the class distribution (C,) of an instance."""
        name = self.name(instance)
        return np.array([other == name for other in self.names], np.float32)


def _class_name(label: str | None) -> str | None:
    """Return the class name in a label, or None for a label without a class."""
    name = (label or "").strip()
    return None if name.lower() in ("", UNLABELED, NO_CLASS) else name


def _painted(points: int, instances: Mapping[int, ExternalInstance]) -> Int32:
    """Return the instance (V,) of each point, 0 = none."""
    ids = np.zeros(points, np.int32)
    for key, one in sorted(instances.items(), key=lambda item: (_confidence(item[1]), -item[0])):
        ids[one.vertices] = key
    return ids


def _confidence(instance: ExternalInstance) -> float:
    return 1.0 if instance.confidence is None else instance.confidence


def _instance(
    key: int,
    external: ExternalInstance,
    class_probabilities: Float32,
    vertices: Float32,
    ids: Int32,
    up: Float64 | None,
) -> Instance:
    own = external.vertices[ids[external.vertices] == key]
    points = vertices[own if len(own) else external.vertices]  # boxes of covered instances contain the whole mask
    return Instance(
        id=key,
        class_probabilities=class_probabilities,
        confidence=_confidence(external),
        observations=0,
        first_frame=NO_FRAME,
        last_frame=NO_FRAME,
        vertices=own,
        aabb=aligned_box(points),
        obb=box_around(points, up),
    )


def _class_ids(ids: Int32, instances: Mapping[int, Instance]) -> Int32:
    """Return the class (V,) of each point, -1 = none."""
    class_ids = np.full(len(ids), -1, np.int32)
    for one in instances.values():
        if len(one.class_probabilities):
            class_ids[one.vertices] = int(one.class_probabilities.argmax())
    return class_ids


def _colors(surface: PlyMesh) -> UInt8:
    """Return the colors (V, 3) of a surface, GRAY without colors. Floating-point colors are in [0, 1]."""
    if not all(channel in surface.properties for channel in CHANNELS):
        return np.full((len(surface.vertices), 3), GRAY, np.uint8)
    values = np.stack([surface.properties[channel] for channel in CHANNELS], axis=1)
    if values.dtype.kind == "f":
        values = np.rint(255 * values.astype(np.float64))
    return np.clip(values, 0, 255).astype(np.uint8)
