"""Stored runs in an upright coordinate frame.

The room frame has z up and the floor at z = 0. It is the world frame, rotated upright by the smallest angle about the
center of the map on the floor, and translated along z. The center keeps x and y. If z is already up in the world frame,
all points keep x and y.
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

from framework.data import LIKELY, Bool, Box, Float32, Float64, InstanceMesh, Int32, Int64, Structure, UInt8
from framework.datasets.frames.world_offset import stored_origin
from framework.errors import DataError
from framework.files.atomic_write import path_exists
from framework.files.tum_trajectory import read_tum
from framework.geometry import skew, transform
from framework.mapping.instances.instance_list import upright_box
from framework.rendering.palette import class_colors, object_colors
from framework.rendering.surface import Surface
from framework.runs.instances_file import StoredInstance
from framework.runs.mesh_file import read_mesh
from framework.runs.stored_map import read_labeled_mesh
from framework.runs.stored_runs import INSTANCES, MESH, TRAJECTORY, read_metrics

LONGEST_NAME = 60  # maximum number of characters of a class in names of files and nodes
UP = np.array([0.0, 0.0, 1.0])
HIGHEST = 1e4  # maximum absolute floor height, m; vertices are float32
SPECK = 0.01  # maximum fraction of vertices in removed components; components at depth edges would enlarge the box
MAX_POINTS = 2**24  # maximum number of points of a room; 100 m^2 of surface have 4 million points at 1 cm voxels
LEVEL = float(np.cos(np.radians(30.0)))  # minimum z of the normal of a supporting surface
UPRIGHT = float(np.sin(np.radians(20.0)))  # maximum |z| of the normal of a wall
SHORTEST_UP = 1e-6  # minimum length of an up direction


@dataclass(frozen=True)
class RoomObject:
    """An object of a room."""

    id: int
    class_name: str
    confidence: float  # in [0, 1]
    existence: float  # probability that the object exists, in [0, 1]
    probability: float | None  # of the class, in [0, 1]; None = unknown
    vertices: Int32  # (M,) indices into the room's mesh, M > 0, without small components
    box: Box  # upright, in the room frame
    color: UInt8  # (3,) sRGB, also used in overview.png
    class_color: UInt8  # (3,) sRGB

    @property
    def name(self) -> str:
        """Unique name, such as `chair_7`."""
        return plain_name(self.class_name, self.id)

    @property
    def footprint(self) -> Float64:
        """Corners (4, 2) of the box on the floor, m, counterclockwise from above."""
        (x, y, _), (width, depth, _) = self.box.center, self.box.extent
        first, second = self.box.rotation[:2, 0] * width / 2, self.box.rotation[:2, 1] * depth / 2
        corners = [-first - second, first - second, first + second, second - first]
        return np.asarray(np.array(corners) + np.array([x, y]))

    @property
    def base(self) -> float:
        """Height of the lowest point, m, in the room frame."""
        return float(self.box.center[2] - self.box.extent[2] / 2)

    @property
    def top(self) -> float:
        """Height of the highest point, m, in the room frame."""
        return float(self.box.center[2] + self.box.extent[2] / 2)


@dataclass(frozen=True)
class UprightRoom:
    """The surface and the objects of a stored run, in the room frame."""

    mesh: InstanceMesh  # in the room frame; labels of all objects of the run, including those not in `objects`
    objects: tuple[RoomObject, ...]  # sorted by id
    poses: Float64  # (F, 4, 4) T_room_camera of the mapped frames
    T_room_world: Float64  # (4, 4)
    up_known: bool  # False = unknown; the z axis of the world frame is used
    floor_known: bool  # False = unknown; z = 0 is the origin of the world frame
    origin: tuple[float, ...] = ()  # (3,) m, of the world frame of the map in that of the recording; () = 0

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.mesh.vertices, self.mesh.triangles)

    def chosen(self, selection: Sequence[str], min_probability: float) -> UprightRoom:
        """Return the room with only the selected objects.

        Args:
            selection: Ids or classes of the objects; () = all objects.
            min_probability: Minimum probability that an object exists, in [0, 1]; ignored for objects selected by id.

        Raises:
            DataError: An id or class is unknown, or all objects of a class are below the minimum probability.
        """
        likely = [one for one in self.objects if one.existence >= min_probability]
        if not selection:
            return replace(self, objects=tuple(likely))
        found: dict[int, RoomObject] = {}
        for word in selection:
            by_id = [one for one in self.objects if str(one.id) == word]
            by_class = [one for one in self.objects if one.class_name == word]
            if not by_id and not by_class:
                raise DataError(f"object: expected an id or class of this run, got {word!r}{_hint(word, self.objects)}")
            of_class = [one for one in by_class if one.existence >= min_probability]
            if not by_id and not of_class:
                best = max(one.existence for one in by_class)
                raise DataError(
                    f"object: expected a probability >= {min_probability:g} for {word!r}, got at most {best:.2f}; "
                    "lower min_probability"
                )
            found |= {one.id: one for one in (*by_id, *of_class)}
        return replace(self, objects=tuple(found[key] for key in sorted(found)))


def plain_name(class_name: str, key: int) -> str:
    """Return a name for files, nodes and prims, such as `chair_7`.

    The name contains only ASCII letters, digits and underscores.
    """
    plain = re.sub(r"[^A-Za-z0-9]+", "_", class_name).strip("_")[:LONGEST_NAME]
    return f"{plain if plain[:1].isalpha() else f'object_{plain}'.rstrip('_')}_{key}"


def read_room(run: Path, up: Sequence[float] | None = None, floor: float | None = None) -> UprightRoom:
    """Read a completed or partial run.

    Args:
        run: Run directory.
        up: Up direction (3,) in the world frame; None = stored direction.
        floor: Floor height along the up direction, m; None = stored height, or unknown if `up` is given.

    Raises:
        DataError: Files are missing, invalid or inconsistent.
    """
    figures = read_metrics(run)
    instances: Sequence[StoredInstance] = []
    if path_exists(run / INSTANCES):
        mesh, instances = read_labeled_mesh(run)
    else:  # a partial run
        mesh = read_mesh(run / MESH)
    direction = _direction(f"{run}: map.up", figures) if up is None else _unit("up", up)
    height = _height(f"{run}: map.floor_m", figures.get("map.floor_m") if floor is None and up is None else floor)
    T_room_world = upright(UP if direction is None else direction, height, middle(mesh.vertices))
    _, poses = read_tum(run / TRAJECTORY) if path_exists(run / TRAJECTORY) else (None, np.zeros((0, 4, 4)))
    placed = replace(mesh, vertices=transform(T_room_world, mesh.vertices.astype(np.float64)).astype(np.float32))
    return UprightRoom(
        mesh=placed,
        objects=objects_of(placed, instances),
        poses=T_room_world @ poses,
        T_room_world=T_room_world,
        up_known=direction is not None,
        floor_known=direction is not None and height is not None,
        origin=stored_origin(figures),
    )


def objects_of(mesh: InstanceMesh, instances: Sequence[StoredInstance]) -> tuple[RoomObject, ...]:
    """Return the objects of a mesh, sorted by id and without small connected components."""
    pieces = _pieces(mesh)
    order = np.argsort(mesh.instance_ids, kind="stable").astype(np.int32)
    ids = mesh.instance_ids[order]
    owned = {
        one.id: order[np.searchsorted(ids, one.id) : np.searchsorted(ids, one.id, side="right")] for one in instances
    }
    seen = sorted((one for one in instances if len(owned[one.id])), key=lambda one: one.id)
    likely = {one.id for one in seen if one.existence >= LIKELY}
    centers = {one.id: mesh.vertices[owned[one.id]].mean(axis=0).astype(np.float64) for one in seen}
    colors = object_colors(centers, likely)
    of_class = class_colors([(one.class_name, one.confidence) for one in seen])
    found = []
    for one in seen:
        own = owned[one.id]
        _, piece, sizes = np.unique(pieces[own], return_inverse=True, return_counts=True)
        own = own[(sizes >= min(SPECK * len(own), int(sizes.max())))[piece]]
        found.append(
            RoomObject(
                id=one.id,
                class_name=one.class_name.encode(
                    errors="backslashreplace"
                ).decode(),  # the name may contain invalid Unicode
                confidence=one.confidence,
                existence=one.existence,
                probability=one.probability,
                vertices=own,
                box=facing(upright_box(mesh.vertices[own], UP)),
                color=colors[one.id],
                class_color=of_class[one.class_name],
            )
        )
    return tuple(found)


def _pieces(mesh: InstanceMesh) -> Int32:
    """Return the connected component (V,) of each vertex."""
    ids = mesh.instance_ids[mesh.triangles]
    joined = mesh.triangles[(ids > 0).all(axis=1) & (ids == ids[:, :1]).all(axis=1)]  # triangles within one object
    edges = np.concatenate([joined[:, :2], joined[:, 1:]]).T
    graph = coo_array((np.ones(edges.shape[1], np.bool_), tuple(edges)), shape=(len(mesh.vertices),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def facing(box: Box) -> Box:
    """Permute the axes of an upright box, so that the first axis is nearest to the x axis."""
    angle = float(np.arctan2(box.rotation[1, 0], box.rotation[0, 0]))
    turns = round(angle / (np.pi / 2))
    yaw = angle - turns * np.pi / 2
    width, depth, height = box.extent
    extent = (depth, width, height) if turns % 2 else (width, depth, height)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Box(box.center, np.array(extent), rotation)


def middle(vertices: Float32) -> Float64:
    """Return the center (3,) of the bounding box of vertices (V, 3); the origin without vertices."""
    if not len(vertices):
        return np.zeros(3)
    return np.asarray((vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2)


def upright(up: Float64, floor: float | None, center: Float64) -> Float64:
    """Return the transform T_room_world (4, 4).

    Args:
        up: Up direction (3,) in the world frame, a unit vector.
        floor: Floor height along `up`, m; None = unknown. It is then 0, and the rotation is about `center` itself.
        center: Center (3,) of the map in the world frame, whose point on the floor keeps x and y.
    """
    if floor is not None:
        center = center + (floor - up @ center) * up
    T = np.eye(4)
    # smallest rotation from `up` to z
    across, cosine = skew(np.cross(up, UP)), float(up @ UP)
    T[:3, :3] += across + across @ across / (1 + cosine) if cosine > -1 + 1e-9 else np.diag([0.0, -2.0, -2.0])
    T[:2, 3] = (center - T[:3, :3] @ center)[:2]
    T[2, 3] = -(floor or 0.0)
    return T


def _direction(where: str, figures: Mapping[str, Any]) -> Float64 | None:
    values = [figures.get(f"map.up.{axis}") for axis in "xyz"]
    return None if None in values else _unit(where, values)


def _height(name: str, value: float | None) -> float | None:
    if value is not None and not abs(value) <= HIGHEST:
        raise DataError(f"{name}: expected a floor height in [-{HIGHEST:g}, {HIGHEST:g}] m, got {value!r:.60}")
    return value


def _unit(name: str, values: Sequence[Any]) -> Float64:
    vector = np.array(values, np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(vector).all() or length < SHORTEST_UP:
        raise DataError(f"{name}: expected a nonzero direction of 3 finite numbers, got {values!r:.60}")
    return vector / length


def _hint(word: str, objects: Sequence[RoomObject]) -> str:
    names = sorted({one.class_name for one in objects})
    if not names:
        return "; the run has no objects"
    close = get_close_matches(word, names, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; classes: {', '.join(names)}"


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the surface of a room, evenly spaced regardless of the triangle sizes."""

    points: Float32  # (P, 3) m, in the room frame
    normal_z: Float32  # (P,) z component of the unit normal
    owner: Int32  # (P,) id of the object that contains the whole triangle, 0 = none
    structure: UInt8  # (P,) `Structure` of the whole triangle, NONE if it is not determined

    @property
    def level(self) -> Bool:
        """Mask (P,) of points on upward-facing surfaces."""
        return np.asarray(self.normal_z > LEVEL)

    @property
    def upright(self) -> Bool:
        """Mask (P,) of points on vertical surfaces, such as walls."""
        return np.asarray(np.abs(self.normal_z) < UPRIGHT)


def surface_points(room: UprightRoom, spacing: float) -> SurfacePoints:
    """Sample points on the surface of a room.

    Triangles are subdivided until no side is longer than `spacing`, m. The points are the centers of the resulting
    triangles.

    Raises:
        DataError: There are more than MAX_POINTS points.
    """
    vertices, triangles = room.mesh.vertices, room.mesh.triangles
    corners = vertices[triangles]  # (F, 3, 3)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0)
    cuts = np.maximum(np.ceil(longest / spacing), 1)
    if float((cuts**2).sum()) > MAX_POINTS:
        raise DataError(
            f"surface: expected at most {MAX_POINTS} points at a spacing of {spacing:g} m, got "
            f"{float((cuts**2).sum()):.0f}; increase resolution (cell size), or map with a larger fuser.voxel_size"
        )
    normals = room.surface.face_normals
    normal_z = (normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-20)).astype(np.float32)
    owner = np.zeros(len(vertices), np.int32)
    for one in room.objects:
        owner[one.vertices] = one.id
    ids = owner[triangles]
    of_triangle = np.where((ids == ids[:, :1]).all(axis=1), ids[:, 0], 0).astype(np.int32)
    kinds = np.zeros_like(triangles, np.uint8) if room.mesh.structure is None else room.mesh.structure[triangles]
    kind = np.where((kinds == kinds[:, :1]).all(axis=1), kinds[:, 0], np.uint8(Structure.NONE))
    points, chosen = [], []
    for n in np.unique(cuts).astype(np.int64).tolist():
        these = np.flatnonzero(cuts == n)
        weights = middles(n)
        points.append(np.einsum("kc,fcx->fkx", weights, corners[these]).reshape(-1, 3))
        chosen.append(np.repeat(these, len(weights)))
    which: Int64 = np.concatenate(chosen) if chosen else np.zeros(0, np.int64)
    return SurfacePoints(
        np.concatenate(points).astype(np.float32) if points else np.zeros((0, 3), np.float32),
        normal_z[which],
        of_triangle[which],
        kind[which],
    )


def middles(n: int) -> Float64:
    """Return the barycentric coordinates (n^2, 3) of the centers of n^2 equal parts of a triangle."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    up, down = i + j < n, i + j < n - 1
    first = np.stack([i[up] + 1 / 3, j[up] + 1 / 3], axis=1)
    second = np.stack([i[down] + 2 / 3, j[down] + 2 / 3], axis=1)
    ij = np.concatenate([first, second]) / n
    return np.column_stack([1 - ij.sum(axis=1), ij])
