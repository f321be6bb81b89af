"""Spatial relations between objects: on, in, next to, and attached to a wall.

The relations are computed from geometry alone. Contact surfaces are occluded, such as the table top under a cup. An
object A is therefore on an object B in one of two cases. The top of B is at the height of the base of A, or B has a
level surface at this height around A.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from framework.data import Bool, Float32, Float64, Int64
from framework.exporting.occupancy import Plan
from framework.exporting.upright_room import RoomObject, UprightRoom, surface_points

SPACING = 0.02  # spacing of surface points, m
CELL = 0.03  # cell size of footprints, m
TOUCHING = 0.05  # maximum distance of a base from its support, m; depth is noisy at edges
ON_FLOOR = 0.10  # maximum height of the observed part of an object above the floor, m; thin legs are incomplete
FOOT = 0.10  # height of the foot above the base, m
AROUND = 2  # width of the border around a foot, cells
COVERED = 0.35  # minimum fraction of the border with a level surface at the height of the base
STACKED = 0.5  # minimum fraction of the foot above the support
WITHIN = 0.9  # minimum fraction of a surface in the box of its container
SECTORS = 36  # number of sectors around an object; the legs of a table fill only a few
ALL_ROUND, UNDER_ROOF = 30, 16  # minimum number of filled sectors of an open container, and of a covered shelf
MAX_NEIGHBOR_DISTANCE = 0.3  # maximum distance of neighbors, m
ON_WALL = 0.10  # maximum distance from a wall, m
HANGING = 0.7  # minimum fraction of points near a wall
STRAY = 2.0  # percentage of the points ignored as noise at the bottom and at the top of a surface
MAX_POINTS = 3000  # approximate maximum number of points of an object for distances


@dataclass(frozen=True)
class Relation:
    """A relation of an object to another object, the floor or the walls."""

    source: int  # object id
    name: str  # "on", "in", "next_to", "attached_to"
    target: int | str  # object id, "floor" or "walls"
    # m, "height" of the base of the source above z = 0, or "distance" between the two surfaces
    measures: Mapping[str, float] = field(default_factory=dict)


def relations(room: UprightRoom, plan: Plan | None) -> list[Relation]:
    """Return all relations between the objects of a room.

    Without a plan, relations to the floor and the walls are omitted.
    """
    found = surface_points(room, SPACING)
    things = []
    for one in room.objects:
        own = found.owner == one.id
        points, level = found.points[own], found.level[own]
        if not len(points):  # too few vertices for a triangle
            points, level = room.mesh.vertices[one.vertices], np.zeros(len(one.vertices), np.bool_)
        things.append(_Thing(one.id, one, points, level))
    standing = [relation for thing in things if (relation := _standing(thing, things, plan)) is not None]
    joined = {frozenset((relation.source, relation.target)) for relation in standing}
    neighbors = [
        Relation(a.id, "next_to", b.id, {"distance": gap})
        for a, b in combinations(things, 2)
        if frozenset((a.id, b.id)) not in joined and (gap := _gap(a, b)) <= MAX_NEIGHBOR_DISTANCE
    ]
    return standing + neighbors


@dataclass(frozen=True)
class _Thing:
    """An object with cached geometric properties."""

    id: int
    box: RoomObject
    points: Float32  # (P, 3) m, in the room frame, P > 0
    level: Bool  # (P,) True for points on upward-facing surfaces

    @cached_property
    def base(self) -> float:
        return float(np.percentile(self.points[:, 2], STRAY))

    @cached_property
    def top(self) -> float:
        return float(np.percentile(self.points[:, 2], 100 - STRAY))

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.points[:: max(1, len(self.points) // MAX_POINTS)])

    @cached_property
    def cells(self) -> set[tuple[int, int]]:
        return _cells(self.points[:, :2])

    @cached_property
    def foot(self) -> set[tuple[int, int]]:
        return _cells(self.points[self.points[:, 2] <= self.base + FOOT, :2])

    @cached_property
    def around_foot(self) -> set[tuple[int, int]]:
        steps = range(-AROUND, AROUND + 1)
        return {(i + di, j + dj) for i, j in self.foot for di in steps for dj in steps} - self.foot


def _standing(thing: _Thing, things: list[_Thing], plan: Plan | None) -> Relation | None:
    """Return the relation of an object to its support, container or wall, or None if unknown."""
    others = [other for other in things if other.id != thing.id]
    holder = next((other for other in others if _is_in(thing, other)), None)
    if holder is not None:
        return Relation(thing.id, "in", holder.id)
    if plan is not None and abs(thing.base) <= TOUCHING:
        return Relation(thing.id, "on", "floor", {"height": thing.base})
    support = max(others, key=lambda other: _carries(other, thing), default=None)
    if support is not None and _carries(support, thing) > 0:
        return Relation(thing.id, "on", support.id, {"height": thing.base})
    if plan is None:
        return None
    if abs(thing.base) <= ON_FLOOR:
        return Relation(thing.id, "on", "floor", {"height": thing.base})
    if _hangs(thing, plan):
        return Relation(thing.id, "attached_to", "walls", {"height": thing.base})
    return None


def _carries(below: _Thing, above: _Thing) -> float:
    """Return a score in [0, 1] for `below` as the support of `above`, where 0 means no support."""
    if below.base >= above.base or below.tree.n < 1:
        return 0.0
    near = below.level & (np.abs(below.points[:, 2] - above.base) <= TOUCHING)
    covered = len(above.around_foot & _cells(below.points[near, :2])) / max(len(above.around_foot), 1)
    if covered >= COVERED:
        return covered
    if abs(below.top - above.base) > TOUCHING:
        return 0.0
    over = len(above.foot & below.cells) / max(len(above.foot), 1)
    return over if over >= STACKED else 0.0


def _is_in(inner: _Thing, outer: _Thing) -> bool:
    """Return True if `inner` is in the box of `outer` and enclosed by its surface."""
    box = outer.box.box
    local = np.abs((inner.points - box.center) @ box.rotation)
    if float(np.mean((local <= box.extent / 2 + SPACING).all(axis=1))) < WITHIN:
        return False
    middle = inner.points[:, :2].mean(axis=0)
    level_with = outer.points[(outer.points[:, 2] > inner.base + SPACING) & (outer.points[:, 2] < inner.top)]
    away = level_with[:, :2] - middle
    angles = np.arctan2(away[:, 1], away[:, 0])
    sectors = len(np.unique(np.floor((angles + np.pi) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS))
    if sectors >= ALL_ROUND:
        return True
    over = outer.points[outer.points[:, 2] > inner.top, :2]
    roofed = len(inner.cells & _cells(over)) / len(inner.cells) >= STACKED
    return roofed and sectors >= UNDER_ROOF


def _gap(a: _Thing, b: _Thing) -> float:
    """Return the distance between two neighboring objects in m, or infinity for other objects."""
    if min(a.top, b.top) < max(a.base, b.base):  # no common height
        return float("inf")
    fewer, more = sorted((a, b), key=lambda thing: thing.tree.n)
    distance, _ = more.tree.query(fewer.tree.data, distance_upper_bound=MAX_NEIGHBOR_DISTANCE)
    return float(np.min(distance))


def _hangs(thing: _Thing, plan: Plan) -> bool:
    if not plan.wall.any():
        return False
    from_walls = ndimage.distance_transform_edt(~plan.wall) * plan.resolution
    rows, columns = plan.cells(thing.points[:, :2].astype(np.float64)).T
    return float(np.mean(from_walls[rows, columns] <= ON_WALL)) >= HANGING


def _cells(xy: Float32 | Float64) -> set[tuple[int, int]]:
    """Return the grid cells that contain points (P, 2), m."""
    numbers: Int64 = np.unique(np.floor(xy / CELL).astype(np.int64), axis=0)
    return set(map(tuple, numbers.tolist()))
