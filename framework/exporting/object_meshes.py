"""A room cut into its objects and the rest of it; each object stands upright on the origin of its own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from framework.data import Float32, Float64, InstanceMesh, UInt8
from framework.exporting.decimation import corners_of, decimated, submesh
from framework.exporting.upright_room import RoomObject, UprightRoom
from framework.geometry import inverse, transform
from framework.runtime.progress import Progress

REST = "room"  # the name of what is of no object


@dataclass(frozen=True)
class Part:
    """An object, or the rest of the room."""

    mesh: InstanceMesh  # in the part's own frame
    T_room_part: Float64  # (4, 4)
    object: RoomObject | None  # None = the rest of the room

    @property
    def name(self) -> str:
        return REST if self.object is None else self.object.name

    @property
    def alone(self) -> Part:
        """By itself: it stands on the origin."""
        return replace(self, T_room_part=np.eye(4))


def parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """The rest of the room, then its objects; together with about so many triangles, None = as many as there are."""
    return _with_fewer([rest(room), *(object_part(room, one) for one in room.objects)], triangles)


def object_parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """Each object, with at most about so many triangles."""
    found = [object_part(room, one) for one in room.objects]
    if triangles is None:
        return found
    return _decimated(found, [triangles] * len(found))


def object_part(room: UprightRoom, one: RoomObject) -> Part:
    """An object's mesh in its own frame: upright, along the sides of its box, whose base has its middle at 0."""
    T_room_part = np.eye(4)
    T_room_part[:3, :3] = one.box.rotation
    T_room_part[:3, 3] = one.box.center - (0.0, 0.0, one.box.extent[2] / 2)
    mesh = submesh(room.mesh, _marked(room.mesh, [one]).astype(np.bool_))
    placed = transform(inverse(T_room_part), mesh.vertices.astype(np.float64)).astype(np.float32)
    return Part(replace(mesh, vertices=placed), T_room_part, one)


def rest(room: UprightRoom) -> Part:
    """What is of none of the room's objects, with the triangles between them, so that there is no gap."""
    owner = _marked(room.mesh, room.objects)
    corners = owner[room.mesh.triangles]
    outside = (corners[:, 0] == 0) | (corners != corners[:, :1]).any(axis=1)
    return Part(submesh(room.mesh, corners_of(room.mesh, outside) | (owner == 0), outside), np.eye(4), None)


def _marked(mesh: InstanceMesh, objects: Sequence[RoomObject]) -> np.ndarray:
    """(V,) the number of the object that each vertex is of, from 1; 0 = none."""
    owner = np.zeros(len(mesh.vertices), np.int32)
    for number, one in enumerate(objects, start=1):
        owner[one.vertices] = number
    return owner


def _with_fewer(found: list[Part], triangles: int | None) -> list[Part]:
    total = sum(len(part.mesh.triangles) for part in found)
    if triangles is None or total <= triangles:
        return found
    share = triangles / total
    return _decimated(found, [round(share * len(part.mesh.triangles)) for part in found])


def _decimated(found: Sequence[Part], most: Sequence[int]) -> list[Part]:
    """The parts with at most so many triangles each. A million takes ten seconds, so it is shown how many are done."""
    fewer = []
    total = sum(len(part.mesh.triangles) for part in found)
    with Progress(total, " triangles", unit_scale=True, leave=False) as bar:
        for part, triangles in zip(found, most, strict=True):
            bar.set_description(f"decimating {part.name}")
            fewer.append(replace(part, mesh=decimated(part.mesh, triangles)))
            bar.update(len(part.mesh.triangles))
    return fewer


GREY = (176, 176, 172)  # of what is no object, where colours tell objects or classes


class Coloring(Enum):
    """What vertices are coloured by."""

    APPEARANCE = "appearance"  # as the camera saw them
    INSTANCE = "instance"
    CLASS = "class"


def part_colors(parts: Sequence[Part], coloring: Coloring) -> list[UInt8]:
    """For each part the colours (V, 3) of its vertices, sRGB."""
    if coloring is Coloring.APPEARANCE:
        return [part.mesh.colors for part in parts]
    grey = np.array(GREY, np.uint8)
    found = []
    for part in parts:
        one = part.object
        own = grey if one is None else one.color if coloring is Coloring.INSTANCE else one.class_color
        found.append(np.tile(own, (len(part.mesh.vertices), 1)))
    return found


def linear(colors: UInt8) -> Float32:
    """Colours in [0, 1] in proportion to light, of sRGB ones (IEC 61966-2-1): what glTF and USD mean by a colour."""
    return _LINEAR[colors]


def _decoded() -> Float32:
    encoded = np.arange(256) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _decoded()  # (256,)
