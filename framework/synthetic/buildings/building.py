"""Synthetic buildings: two rows of furnished rooms along a corridor.

In the world frame, x is along the corridor, z is up, and the origin is on the floor in the middle of the corridor's
western end. Every room has a doorway to the corridor and to the adjacent rooms of its row, so that the rooms and the
corridor form loops. Rooms of one design are identical.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from framework.data import Float32, Float64
from framework.synthetic import paints
from framework.synthetic.furniture import clutter
from framework.synthetic.furniture.groups import Place, against_wall
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import axis_rotation, rounded_box
from framework.synthetic.layout import Layout, arrange, place_on_wall
from framework.synthetic.lights import Lamp, bake
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.room import DOORWAY, HEIGHT, MIN_ROOM_SIZES, RoomKind, furniture_groups, lamps_of, shell_of
from framework.synthetic.surfaces import Surfaces, assemble

MIN_ROOMS = 4  # two in each row, so that there is a loop
CORRIDOR_WIDTH = 1.8  # m
WALL = 0.12  # m, thickness of the walls between rooms
WALKWAY = 1.5  # m, width of the free strip of each room along the corridor
LAMP_SPACING = 4.0  # m, maximum distance between the lamps of the corridor
PICTURE_HEIGHT = 1.35  # m, height of the pictures in the corridor
KINDS = (RoomKind.LIVING_ROOM, RoomKind.OFFICE, RoomKind.BEDROOM, RoomKind.KITCHEN)


@dataclass(frozen=True)
class Zone:
    """A room or the corridor. Its light comes from its own lamps."""

    objects: tuple[tuple[int, Furniture], ...]  # pairs of instance id and object in the world frame; id 0 = shell
    lamps: tuple[Lamp, ...]


@dataclass(frozen=True)
class RoomPlace:
    """The place of a room at the corridor."""

    x: float  # m, middle of the room along the corridor, which is the position of its doorway
    width: float  # m, along the corridor
    depth: float  # m, across the corridor
    side: int  # 1 = the row at +y, -1 = the row at -y


@dataclass(frozen=True)
class Building:
    """Furnished rooms along a corridor."""

    rooms: tuple[RoomPlace, ...]  # from west to east, the row at +y first
    zones: tuple[Zone, ...]  # the rooms and the corridor
    length: float  # m, of the corridor

    @cached_property
    def surfaces(self) -> Surfaces:
        """The exact triangles of all zones."""
        return assemble(one for zone in self.zones for one in zone.objects)

    def irradiance(self) -> Float32:
        """Return the irradiance (V, 3) of the vertices of `surfaces`, linear RGB."""
        lit = []
        for zone in self.zones:
            surfaces = assemble(zone.objects)
            lit.append(bake(surfaces, RayCaster(surfaces.vertices, surfaces.triangles), list(zone.lamps)))
        return np.concatenate(lit)


def plan_building(rooms: int, designs: int, seed: Sequence[int]) -> Building:
    """Return a random building.

    Args:
        rooms: The number of rooms, at least MIN_ROOMS.
        designs: The number of different designs of rooms, at least 1. Room k has the design k modulo `designs`.
        seed: The seed of the random numbers.
    """
    planned = [_Design.random(k, seed) for k in range(min(rooms, designs))]
    northern = (rooms + 1) // 2
    places, zones, first_id, ends = [], [], 1, {1: 0.0, -1: 0.0}
    for k in range(rooms):
        design, side = planned[k % designs], 1 if k < northern else -1
        layout = design.layout
        place = RoomPlace(ends[side] + layout.width / 2, layout.width, layout.depth, side)
        ends[side] += layout.width + WALL
        west, east = k not in (0, northern), k not in (northern - 1, rooms - 1)
        zones.append(_room(design, place, west, east, first_id))
        first_id += len(zones[-1].objects) - 1
        places.append(place)
    length = max(ends.values()) - WALL
    zones.append(_corridor(places, length, first_id, np.random.default_rng([*seed, rooms])))
    return Building(tuple(places), tuple(zones), length)


@dataclass(frozen=True)
class _Design:
    """A furnished room in its own frame, without its shell. The corridor is at -y."""

    layout: Layout
    lamps: tuple[Lamp, ...]
    seed: tuple[int, ...]  # seed of the materials of the shell

    @classmethod
    def random(cls, number: int, seed: Sequence[int]) -> _Design:
        rng = np.random.default_rng([*seed, number])
        kind = KINDS[number % len(KINDS)]
        groups = [group for group in furniture_groups(kind, rng) if group.name != "door"]
        width, depth = MIN_ROOM_SIZES[kind]
        layout = arrange(groups, width, depth + WALKWAY / 2, rng, WALKWAY)
        globe = clutter.ceiling_lamp(rng).placed(rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), HEIGHT)
        layout = replace(layout, pieces=[*layout.pieces, globe])
        return cls(layout, tuple(lamps_of(layout.pieces)), (*seed, number, 1))


def _room(design: _Design, place: RoomPlace, west: bool, east: bool, first_id: int) -> Zone:
    """Return a room, which has doorways to its western and eastern neighbor if they exist."""
    layout, from_wall = design.layout, (WALKWAY - design.layout.depth) / 2
    right, left = (east, west) if place.side > 0 else (west, east)  # as seen from the corridor
    doorways = {0: [0.0], 1: [from_wall] * right, 3: [-from_wall] * left}
    shell = _shell(layout.width, layout.depth, doorways, np.random.default_rng(design.seed))
    angle = 0.0 if place.side > 0 else np.pi
    y = place.side * (CORRIDOR_WIDTH / 2 + WALL + layout.depth / 2)
    return _zone([shell, *layout.pieces], design.lamps, first_id, (place.x, y, angle))


def _corridor(places: Sequence[RoomPlace], length: float, first_id: int, rng: Rng) -> Zone:
    """Return the corridor, with a closed door at both ends and a picture opposite each doorway."""
    doorways = {
        wall: [side * (length / 2 - it.x) for it in places if it.side == side] for wall, side in ((2, 1), (0, -1))
    }
    pieces = [_shell(length, CORRIDOR_WIDTH, doorways, rng)]
    for wall in (1, 3):
        x, y, angle = place_on_wall(wall, 0.0, length, CORRIDOR_WIDTH)
        door = clutter.door(rng)
        pieces.append(door.placed(0, against_wall(door)).placed(x, y, 0, angle))
    for wall, opposite in ((2, 0), (0, 2)):
        for along in [-offset for offset in doorways[opposite]]:
            if min(abs(along - offset) for offset in doorways[wall]) > DOORWAY[0]:
                x, y, angle = place_on_wall(wall, along, length, CORRIDOR_WIDTH)
                pieces.append(clutter.painting(rng).placed(0, 0.002, PICTURE_HEIGHT).placed(x, y, 0, angle))
    count = max(1, round(length / LAMP_SPACING))
    positions = length * ((np.arange(count) + 0.5) / count - 0.5)
    pieces += [clutter.ceiling_lamp(rng).placed(float(x), 0, HEIGHT) for x in positions]
    return _zone(pieces, lamps_of(pieces[1:]), first_id, (length / 2, 0.0, 0.0))


def _zone(pieces: Sequence[Furniture], lamps: Iterable[Lamp], first_id: int, place: Place) -> Zone:
    """Return a zone at a place, given its shell, its objects and its lamps in its own frame."""
    x, y, angle = place
    placed = (piece.placed(x, y, 0, angle) for piece in pieces)
    numbers = [0, *range(first_id, first_id + len(pieces) - 1)]
    return Zone(tuple(zip(numbers, placed, strict=True)), tuple(_placed(lamp, x, y, angle) for lamp in lamps))


def _shell(width: float, depth: float, doorways: Mapping[int, Sequence[float]], rng: Rng) -> Furniture:
    """Return the shell of a zone, with this side's half of the frame of each doorway."""
    shell = shell_of(width, depth, rng, doorways)
    material = paints.paint(rng, (0.93, 0.92, 0.90))
    width_of, height = DOORWAY
    thick = WALL / 2 + 0.015
    frame = Furniture("doorway")
    frame.add_pair(rounded_box(0.06, thick, height + 0.06), material, width_of / 2 + 0.03, 0, (height + 0.06) / 2)
    frame.add(rounded_box(width_of, thick, 0.06), material, 0, 0, height + 0.03)
    frame.add(rounded_box(width_of, thick, 0.02), material, 0, 0, -0.008)
    for wall, offsets in doorways.items():
        for offset in offsets:
            x, y, angle = place_on_wall(wall, offset, width, depth)
            shell.parts += frame.placed(0, thick / 2 - WALL / 2).placed(x, y, 0, angle).parts
    return shell


def _placed(lamp: Lamp, x: float, y: float, angle: float) -> Lamp:
    """Return a lamp that is rotated about z, then translated."""
    R: Float64 = axis_rotation("z", angle)
    points, normals = (np.einsum("ck,sk->sc", R, vectors) for vectors in (lamp.points, lamp.normals))
    return Lamp(points + np.array([x, y, 0.0]), normals, lamp.power)
