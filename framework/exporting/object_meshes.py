"""Object meshes, upright at the origin of their own frames, and the mesh of the rest of the room."""

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
    """An object, or the rest of the room."""

    mesh: InstanceMesh  # in the part's own frame
    T_room_part: Float64  # (4, 4)
    object: RoomObject | None  # None = the rest of the room

    @property
    def name(self) -> str:
        return REST if self.object is None else self.object.name

    @property
    def alone(self) -> Part:
        """The part at the origin."""
        return replace(self, T_room_part=np.eye(4))


def parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """Return the rest of the room and its objects, decimated to about `triangles` triangles in total; None = all."""
    found = [rest(room), *(object_part(room, one) for one in room.objects)]
    total = sum(len(part.mesh.triangles) for part in found)
    if triangles is None or total <= triangles:
        return found
    return _decimated(found, [round(triangles / total * len(part.mesh.triangles)) for part in found])


def object_parts(room: UprightRoom, triangles: int | None = None) -> list[Part]:
    """Return the objects, each in its own frame and decimated to about `triangles` triangles; None = no decimation."""
    found = [object_part(room, one) for one in room.objects]
    return found if triangles is None else _decimated(found, [triangles] * len(found))


def object_part(room: UprightRoom, one: RoomObject) -> Part:
    """Return an object in its own frame: upright, aligned with its box, with the center of its base at the origin."""
    T_room_part = np.eye(4)
    T_room_part[:3, :3] = one.box.rotation
    T_room_part[:3, 3] = one.box.center - (0.0, 0.0, one.box.extent[2] / 2)
    mesh = submesh(room.mesh, _marked(room.mesh, [one]).astype(np.bool_))
    placed = transform(inverse(T_room_part), mesh.vertices.astype(np.float64)).astype(np.float32)
    return Part(replace(mesh, vertices=placed), T_room_part, one)


def rest(room: UprightRoom) -> Part:
    """Return the rest of the room. It includes the triangles between objects, to avoid gaps."""
    owner = _marked(room.mesh, room.objects)
    corners = owner[room.mesh.triangles]
    outside = (corners[:, 0] == 0) | (corners != corners[:, :1]).any(axis=1)
    return Part(submesh(room.mesh, corners_of(room.mesh, outside) | (owner == 0), outside), np.eye(4), None)


def _marked(mesh: InstanceMesh, objects: Sequence[RoomObject]) -> np.ndarray:
    """Return for each vertex (V,) the 1-based position of its object in `objects`; 0 = no object."""
    owner = np.zeros(len(mesh.vertices), np.int32)
    for number, one in enumerate(objects, start=1):
        owner[one.vertices] = number
    return owner


def _decimated(found: Sequence[Part], most: Sequence[int]) -> list[Part]:
    """Return each part, decimated to at most the number of triangles in `most` (at least MIN_TRIANGLES).

    A progress bar is shown, because a million triangles take 10 s.
    """
    fewer = []
    total = sum(len(part.mesh.triangles) for part in found)
    with Progress(total, " triangles", unit_scale=True, leave=False) as bar:
        for part, triangles in zip(found, most, strict=True):
            bar.set_description(f"decimating {part.name}")
            fewer.append(replace(part, mesh=decimated(part.mesh, triangles)))
            bar.update(len(part.mesh.triangles))
    return fewer


GRAY = (176, 176, 172)  # color of the rest of the room, sRGB


class Coloring(Enum):
    """The coloring of vertices."""

    APPEARANCE = "appearance"  # colors of the camera images
    INSTANCE = "instance"
    CLASS = "class"


def part_colors(parts: Sequence[Part], coloring: Coloring) -> list[UInt8]:
    """Return the vertex colors (V, 3) of each part, sRGB."""
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
    """Convert sRGB (IEC 61966-2-1) to linear colors in [0, 1] for glTF and USD."""
    encoded = np.arange(256) / 255
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.asarray(table[colors])
