"""Meshes of the objects and of the rest of the room.

Each object is upright at the origin of its own frame.
"""

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

REST = "room"  # name of the rest of the room


@dataclass(frozen=True)
class Part:
    """The mesh of one object, or of the rest of the room."""

    mesh: InstanceMesh  # in the part's own frame
    T_room_part: Float64  # (4, 4)
    object: RoomObject | None  # None = the rest of the room

    @property
    def name(self) -> str:
        return REST if self.object is None else self.object.name

    @property
    def alone(self) -> Part:
        """The part, moved to the origin."""
        return replace(self, T_room_part=np.eye(4))


def parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """Return the rest of the room and its objects.

    Args:
        room: Room.
        triangles: Approximate number of triangles of all parts together; None = no decimation.
    """
    found = [rest(room), *(object_part(room, one) for one in room.objects)]
    total = sum(len(part.mesh.triangles) for part in found)
    if triangles is None or total <= triangles:
        return found
    return _decimated(found, [round(triangles / total * len(part.mesh.triangles)) for part in found])


def object_parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """Return the objects of a room, each in its own frame.

    Args:
        room: Room.
        triangles: Maximum number of triangles of each object; None = no decimation.
    """
    found = [object_part(room, one) for one in room.objects]
    return found if triangles is None else _decimated(found, [triangles] * len(found))


def object_part(room: UprightRoom, one: RoomObject) -> Part:
    """Return an object in its own frame.

    The frame is upright and aligned with the box. Its origin is the center of the base.
    """
    T_room_part = np.eye(4)
    T_room_part[:3, :3] = one.box.rotation
    T_room_part[:3, 3] = one.box.center - (0.0, 0.0, one.box.extent[2] / 2)
    mesh = submesh(room.mesh, _marked(room.mesh, [one]).astype(np.bool_))
    placed = transform(inverse(T_room_part), mesh.vertices.astype(np.float64)).astype(np.float32)
    return Part(replace(mesh, vertices=placed), T_room_part, one)


def rest(room: UprightRoom) -> Part:
    """Return the part of the room outside of objects."""
    owner = _marked(room.mesh, room.objects)
    corners = owner[room.mesh.triangles]
    # triangles between two objects are included to avoid gaps
    outside = (corners[:, 0] == 0) | (corners != corners[:, :1]).any(axis=1)
    return Part(submesh(room.mesh, corners_of(room.mesh, outside) | (owner == 0), outside), np.eye(4), None)


def _marked(mesh: InstanceMesh, objects: Sequence[RoomObject]) -> np.ndarray:
    """Return the index (V,) of the object of each vertex, starting at 1, or 0 for no object."""
    owner = np.zeros(len(mesh.vertices), np.int32)
    for number, one in enumerate(objects, start=1):
        owner[one.vertices] = number
    return owner


def _decimated(found: Sequence[Part], most: Sequence[int]) -> list[Part]:
    """Decimate each part to the number of triangles in `most`."""
    fewer = []
    total = sum(len(part.mesh.triangles) for part in found)
    with Progress(total, " triangles", unit_scale=True, leave=False) as bar:  # 10 s per million triangles
        for part, triangles in zip(found, most, strict=True):
            bar.set_description(f"decimating {part.name}")
            fewer.append(replace(part, mesh=decimated(part.mesh, triangles)))
            bar.update(len(part.mesh.triangles))
    return fewer


GRAY = (176, 176, 172)  # color of the rest of the room, sRGB


class Coloring(Enum):
    """The color mode of exported meshes."""

    APPEARANCE = "appearance"  # colors of the camera images
    INSTANCE = "instance"
    CLASS = "class"


def part_colors(parts: Sequence[Part], coloring: Coloring) -> list[UInt8]:
    """Return the sRGB vertex colors (V, 3) of each part."""
    if coloring is Coloring.APPEARANCE:
        return [part.mesh.colors for part in parts]
    gray = np.array(GRAY, np.uint8)
    found = []
    for part in parts:
        one = part.object
        own = gray if one is None else one.color if coloring is Coloring.INSTANCE else one.class_color
        found.append(np.tile(own, (len(part.mesh.vertices), 1)))
    return found


def linear(colors: UInt8) -> Float32:
    """Convert 8-bit sRGB colors to linear colors in [0, 1]."""
    encoded = np.arange(256) / 255
    # IEC 61966-2-1
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.asarray(table[colors])
