"""How objects stand to each other: on, in, next to, attached to a wall. By geometry alone, whatever they are.

Where things touch, nobody sees their surfaces: the table under a cup is not in the map. So a thing is on another one
where that has a level surface around its foot, at the height of it, or where its top is there and below it.
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
from framework.exporting.surface_points import surface_points
from framework.exporting.upright_room import RoomObject, UprightRoom

SPACING = 0.02  # m, of the points that stand for a surface
CELL = 0.03  # m, of footprints
TOUCHING = 0.05  # m, between a base and what it stands on: depth is noisy, and its edge mixes with what is beneath
ON_FLOOR = 0.10  # m, above which nothing that is seen stands on the floor; legs are thin, and end early
FOOT = 0.10  # m, of a thing above its base, that stands on something
AROUND = 2  # cells about a foot, in which what it stands on is seen
COVERED = 0.35  # of these, that have a level surface at its base; what lies beside it has less
STACKED = 0.5  # of a foot's cells, that are over the other thing
WITHIN = 0.9  # of a thing's surface in the box of another one, that holds it
SECTORS = 36  # of directions around it; the legs of a table fill a few
ALL_ROUND, UNDER_ROOF = 30, 16  # of these with the other one's surface at its height: in a bowl; on a cupboard's shelf
BESIDE = 0.3  # m, between surfaces, up to which things are next to each other
ON_WALL = 0.10  # m from a wall, within which is all of what hangs on it
HANGING = 0.7  # of its cells
STRAY = 2.0  # % of a surface at its lower and at its upper end that may be noise
MOST_POINTS = 3000  # of an object, that distances are measured from


@dataclass(frozen=True)
class Relation:
    """`source` is `name` `target`; these are objects' ids, or "floor" and "walls"."""

    source: int
    name: str  # "on", "in", "next_to", "attached_to"
    target: int | str
    measures: Mapping[str, float] = field(default_factory=dict)  # m


def relations(room: UprightRoom, plan: Plan | None) -> list[Relation]:
    """All relations of a room's objects, by their ids. Without a plan nothing is said of floor and walls."""
    found = surface_points(room, SPACING)
    things = [_thing(room, one, found.points, found.owner == one.id, found.level) for one in room.objects]
    standing = [relation for thing in things if (relation := _standing(thing, things, plan)) is not None]
    joined = {frozenset((relation.source, relation.target)) for relation in standing}
    beside = [
        Relation(a.id, "next_to", b.id, {"distance": gap})
        for a, b in combinations(things, 2)
        if frozenset((a.id, b.id)) not in joined and (gap := _gap(a, b)) <= BESIDE
    ]
    return standing + beside


@dataclass(frozen=True)
class _Thing:
    """An object as its relations are found."""

    id: int
    box: RoomObject
    points: Float32  # (P, 3) m, P > 0
    level: Bool  # (P,)

    @cached_property
    def base(self) -> float:
        return float(np.percentile(self.points[:, 2], STRAY))

    @cached_property
    def top(self) -> float:
        return float(np.percentile(self.points[:, 2], 100 - STRAY))

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.points[:: max(1, len(self.points) // MOST_POINTS)])

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


def _thing(room: UprightRoom, one: RoomObject, points: Float32, own: Bool, level: Bool) -> _Thing:
    if own.any():
        return _Thing(one.id, one, points[own], level[own])
    vertices = room.mesh.vertices[one.vertices]  # of too few for a triangle
    return _Thing(one.id, one, vertices, np.zeros(len(vertices), np.bool_))


def _standing(thing: _Thing, things: list[_Thing], plan: Plan | None) -> Relation | None:
    """What a thing stands on, is in or hangs on; None where that cannot be told."""
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
    """How well one thing carries another one, in [0, 1]; 0 = it does not."""
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
    """Whether a thing is in another one: within its box, with that one's surface around it or over and around it."""
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
    """m between two surfaces whose heights overlap; infinite where they do not, or are far from each other."""
    if min(a.top, b.top) < max(a.base, b.base):
        return float("inf")
    fewer, more = sorted((a, b), key=lambda thing: thing.tree.n)
    distance, _ = more.tree.query(fewer.tree.data, distance_upper_bound=BESIDE)
    return float(np.min(distance))


def _hangs(thing: _Thing, plan: Plan) -> bool:
    if not plan.wall.any():
        return False
    from_walls = ndimage.distance_transform_edt(~plan.wall) * plan.resolution
    rows, columns = plan.cells(thing.points[:, :2].astype(np.float64)).T
    return float(np.mean(from_walls[rows, columns] <= ON_WALL)) >= HANGING


def _cells(xy: Float32 | Float64) -> set[tuple[int, int]]:
    """The cells of a footprint that points (P, 2) m are over."""
    numbers: Int64 = np.unique(np.floor(xy / CELL).astype(np.int64), axis=0)
    return set(map(tuple, numbers.tolist()))
