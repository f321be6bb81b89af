"""A stored run as exports see it: its surface and its objects in a frame that stands upright on the floor.

The room's frame: metres, z up, the floor at z = 0. It is the world turned by the smallest angle that makes it upright,
and moved along z; so where the world's z is up, x and y are the world's own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from framework.data import Box, Float64, InstanceMesh, Int32, UInt8
from framework.errors import DataError
from framework.files.atomic_write import is_there
from framework.files.tum_trajectory import read_tum
from framework.geometry import skew, transform
from framework.mapping.instances.instance_list import upright_box
from framework.rendering.palette import class_colors, object_colors
from framework.rendering.surface import Surface
from framework.runs.instances_file import StoredInstance
from framework.runs.mesh_file import read_mesh
from framework.runs.run_directory import LIKELY
from framework.runs.stored_map import read_labeled_mesh
from framework.runs.stored_runs import INSTANCES, MESH, TRAJECTORY, read_figures

LONGEST_NAME = 60  # characters of a class, in the names of files and of nodes
UP = np.array([0.0, 0.0, 1.0])
HIGHEST = 1e4  # m, of a floor; vertices are float32
SPECK = 0.01  # of an object's vertices: labels leak through edges of depth, and would widen its box
SHORTEST_UP = 1e-6  # of a vector that may say what is up


@dataclass(frozen=True)
class RoomObject:
    """One object of a room."""

    id: int
    class_name: str
    confidence: float  # in [0, 1]
    probability: float | None  # of its class, in [0, 1]; None = the record does not tell
    vertices: Int32  # (M,) of the room's mesh, M > 0, without specks
    box: Box  # upright, in the room
    color: UInt8  # (3,) sRGB, of its own: that of overview.png
    class_color: UInt8  # (3,) sRGB, of all objects of its class

    @property
    def name(self) -> str:
        """`chair_7`, each object another one."""
        return plain_name(self.class_name, self.id)

    @property
    def footprint(self) -> Float64:
        """(4, 2) m, the corners of its box on the floor, counterclockwise from above."""
        (x, y, _), (width, depth, _) = self.box.center, self.box.extent
        first, second = self.box.rotation[:2, 0] * width / 2, self.box.rotation[:2, 1] * depth / 2
        corners = [-first - second, first - second, first + second, second - first]
        return np.asarray(np.array(corners) + np.array([x, y]))

    @property
    def base(self) -> float:
        """m, of its lowest point."""
        return float(self.box.center[2] - self.box.extent[2] / 2)

    @property
    def top(self) -> float:
        """m, of its highest point."""
        return float(self.box.center[2] + self.box.extent[2] / 2)


@dataclass(frozen=True)
class UprightRoom:
    """A stored run's surface and objects."""

    mesh: InstanceMesh  # vertices in the room; labels of all objects, also of those that are not among `objects`
    objects: tuple[RoomObject, ...]  # by id
    poses: Float64  # (F, 4, 4) T_room_camera of the frames that were mapped
    T_room_world: Float64  # (4, 4)
    up_known: bool  # else the world's z is taken for up
    floor_known: bool  # else z = 0 is where the world has it

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.mesh.vertices, self.mesh.triangles)

    def chosen(self, asked: Sequence[str], min_confidence: float) -> UprightRoom:
        """With the objects that are asked for, by id or class, and with a class those of some confidence; all = ().

        Raises DataError for an object or a class that there is not.
        """
        likely = [one for one in self.objects if one.confidence >= min_confidence]
        if not asked:
            return replace(self, objects=tuple(likely))
        found: dict[int, RoomObject] = {}
        for word in asked:
            by_id = [one for one in self.objects if str(one.id) == word]
            by_class = [one for one in self.objects if one.class_name == word]
            if not by_id and not by_class:
                raise DataError(f"there is no object {word!r} in this run{_hint(word, self.objects)}")
            of_class = [one for one in by_class if one.confidence >= min_confidence]
            if not by_id and not of_class:
                best = max(one.confidence for one in by_class)
                raise DataError(f"no {word!r} has a confidence of {min_confidence:g}; the highest is {best:.2f}")
            found |= {one.id: one for one in (*by_id, *of_class)}
        return replace(self, objects=tuple(found[key] for key in sorted(found)))


def plain_name(class_name: str, key: int) -> str:
    """`chair_7`: letters of ASCII, digits and underscores, so that it may name a file, a node or a prim."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", class_name).strip("_")[:LONGEST_NAME]
    return f"{plain if plain[:1].isalpha() else f'object_{plain}'.rstrip('_')}_{key}"


def read_room(run: Path, up: Sequence[float] | None = None, floor: float | None = None) -> UprightRoom:
    """The room of a run, whole or partial; `up` (3,) and `floor` (m along up) say what its record does not tell.

    Raises DataError where there is no run, or its files cannot be read or are not of one run.
    """
    figures = read_figures(run)
    instances: Sequence[StoredInstance] = []
    if is_there(run / INSTANCES):
        mesh, instances = read_labeled_mesh(run)
    else:  # of a run that ended early
        mesh = read_mesh(run / MESH)
    direction = _direction(f"{run}: map.up", figures) if up is None else _unit("up", up)
    height = _height(f"{run}: map.floor_m", figures.get("map.floor_m") if floor is None and up is None else floor)
    T_room_world = upright(UP if direction is None else direction, height or 0.0)
    _, poses = read_tum(run / TRAJECTORY) if is_there(run / TRAJECTORY) else (None, np.zeros((0, 4, 4)))
    placed = replace(mesh, vertices=transform(T_room_world, mesh.vertices.astype(np.float64)).astype(np.float32))
    return UprightRoom(
        mesh=placed,
        objects=objects_of(placed, instances),
        poses=T_room_world @ poses,
        T_room_world=T_room_world,
        up_known=direction is not None,
        floor_known=direction is not None and height is not None,
    )


def objects_of(mesh: InstanceMesh, instances: Sequence[StoredInstance]) -> tuple[RoomObject, ...]:
    """Those that have vertices in a room's mesh, by id, without their specks: loose pieces of less than SPECK."""
    pieces = _pieces(mesh)
    order = np.argsort(mesh.instance_ids, kind="stable").astype(np.int32)
    ids = mesh.instance_ids[order]
    owned = {
        one.id: order[np.searchsorted(ids, one.id) : np.searchsorted(ids, one.id, side="right")] for one in instances
    }
    seen = sorted((one for one in instances if len(owned[one.id])), key=lambda one: one.id)
    likely = {one.id for one in seen if one.confidence >= LIKELY}
    colors = object_colors({one.id: mesh.vertices[owned[one.id]].mean(axis=0) for one in seen}, likely)
    of_class = class_colors([(one.class_name, one.confidence) for one in seen])
    found = []
    for one in seen:
        own = owned[one.id]
        _, piece, sizes = np.unique(pieces[own], return_inverse=True, return_counts=True)
        own = own[(sizes >= min(SPECK * len(own), sizes.max()))[piece]]
        found.append(
            RoomObject(
                id=one.id,
                class_name=one.class_name.encode(errors="backslashreplace").decode(),  # it may be no text
                confidence=one.confidence,
                probability=one.probability,
                vertices=own,
                box=facing(upright_box(mesh.vertices[own], UP)),
                color=colors[one.id],
                class_color=of_class[one.class_name],
            )
        )
    return tuple(found)


def _pieces(mesh: InstanceMesh) -> Int32:
    """(V,) the number of the piece that each vertex is in: what triangles join whose corners are of one object."""
    ids = mesh.instance_ids[mesh.triangles]
    joined = mesh.triangles[(ids > 0).all(axis=1) & (ids == ids[:, :1]).all(axis=1)]
    edges = np.concatenate([joined[:, :2], joined[:, 1:]]).T
    graph = coo_array((np.ones(edges.shape[1], np.bool_), tuple(edges)), shape=(len(mesh.vertices),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def facing(box: Box) -> Box:
    """The same upright box, with that of its sides for the first that is nearest to the room's x axis."""
    angle = float(np.arctan2(box.rotation[1, 0], box.rotation[0, 0]))
    turns = round(angle / (np.pi / 2))
    yaw = angle - turns * np.pi / 2
    width, depth, height = box.extent
    extent = (depth, width, height) if turns % 2 else (width, depth, height)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Box(box.center, np.array(extent), rotation)


def upright(up: Float64, floor: float) -> Float64:
    """T_room_world (4, 4): the smallest turn that takes the unit vector `up` to z, and `floor` m along it to z = 0."""
    T = np.eye(4)
    across, cosine = skew(np.cross(up, UP)), float(up @ UP)
    T[:3, :3] += across + across @ across / (1 + cosine) if cosine > -1 + 1e-9 else np.diag([0.0, -2.0, -2.0])
    T[2, 3] = -floor
    return T


def _direction(where: str, figures: Mapping[str, Any]) -> Float64 | None:
    values = [figures.get(f"map.up.{axis}") for axis in "xyz"]
    return None if None in values else _unit(where, values)


def _height(name: str, value: float | None) -> float | None:
    if value is not None and not abs(value) <= HIGHEST:
        raise DataError(f"{name}, the floor, must be a height within {HIGHEST:g} m, found {value!r:.60}")
    return value


def _unit(name: str, values: Sequence[Any]) -> Float64:
    vector = np.array(values, np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(vector).all() or length < SHORTEST_UP:
        raise DataError(f"{name} must be three numbers, a direction, found {values!r:.60}")
    return vector / length


def _hint(word: str, objects: Sequence[RoomObject]) -> str:
    names = sorted({one.class_name for one in objects})
    if not names:
        return ", which has none"
    close = get_close_matches(word, names, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; it has {', '.join(names)}, and their ids"
