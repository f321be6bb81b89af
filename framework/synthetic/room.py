"""Random furnished rooms.

In the world frame, x and y are along the walls, z is up, and the origin is at the center of the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from framework.data import Float64, SceneTruth, Structure
from framework.synthetic import paints
from framework.synthetic.furniture import clutter, fixtures, groups, seating
from framework.synthetic.furniture.groups import Group, single
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import panel, rounded_box
from framework.synthetic.layout import Layout, arrange, place_on_wall, strew
from framework.synthetic.lights import Lamp, globe, rectangle
from framework.synthetic.paints import Material, Texture
from framework.synthetic.surfaces import Surfaces, assemble

HEIGHT = 2.55  # m, height of the ceiling
ON_PLANE = 0.01  # m, maximum distance of points of the floor and the ceiling from their planes
DOORWAY = (0.9, 2.05)  # m, width and height of a doorway
NO_DOORWAYS: Mapping[int, Sequence[float]] = {}
WARM, DAY = (1.0, 0.86, 0.66), (0.86, 0.94, 1.0)  # linear RGB colors of lamps and of daylight


class RoomKind(StrEnum):
    """Kind of a room."""

    STUDIO = "studio"
    LIVING_ROOM = "living_room"
    BEDROOM = "bedroom"
    KITCHEN = "kitchen"
    OFFICE = "office"


MIN_ROOM_SIZES = {  # m, width and depth of the smallest candidate room
    RoomKind.STUDIO: (5.6, 4.8),
    RoomKind.LIVING_ROOM: (4.6, 4.2),
    RoomKind.BEDROOM: (4.2, 3.8),
    RoomKind.KITCHEN: (4.0, 3.6),
    RoomKind.OFFICE: (4.4, 3.8),
}


@dataclass(frozen=True)
class Room:
    """A furnished room with lamps."""

    layout: Layout
    objects: tuple[tuple[int, Furniture], ...]  # pairs of instance id and object; id 0 = shell
    lamps: tuple[Lamp, ...]
    surfaces: Surfaces  # exact triangles of all objects


def furnish(kind: RoomKind, rng: Rng) -> Room:
    """Return a random room of a given kind."""
    return furnish_with(furniture_groups(kind, rng), *MIN_ROOM_SIZES[kind], rng)


def furnish_with(contents: list[Group], width: float, depth: float, rng: Rng, strewn: Sequence[Furniture] = ()) -> Room:
    """Return a room with given furniture.

    Args:
        contents: The furniture groups, largest first.
        width: The minimum width of the room, m.
        depth: The minimum depth of the room, m.
        rng: The random number generator.
        strewn: Objects that are placed on the floor next to furniture if they fit.
    """
    layout = strew(arrange(contents, width, depth, rng), strewn, rng)
    globe_lamp = clutter.ceiling_lamp(rng).placed(rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), HEIGHT)
    pieces = [*layout.pieces, globe_lamp]
    objects = ((0, shell_of(layout.width, layout.depth, rng)), *enumerate(pieces, start=1))
    return Room(layout, objects, tuple(lamps_of(pieces)), assemble(objects))


def shell_structure(truth: SceneTruth) -> SceneTruth:
    """Return the ground truth of a synthetic scene with the structure of its shell, which has the instance id 0."""
    z = truth.points_world[:, 2]
    of_shell = np.full(len(z), Structure.WALL, np.uint8)
    of_shell[z < ON_PLANE] = Structure.FLOOR
    of_shell[z > HEIGHT - ON_PLANE] = Structure.CEILING
    return replace(truth, structure=np.where(truth.instance_ids == 0, of_shell, np.uint8(Structure.NONE)))


def furniture_groups(kind: RoomKind, rng: Rng) -> list[Group]:
    """Return the furniture groups of a room, largest first."""
    door, window = single("door", clutter.door(rng)), single("window", clutter.window(rng), z=0.95, hung=True)
    bag = single("backpack", fixtures.backpack(rng))
    extras = [
        single("plant", clutter.plant(rng)),
        single("lamp", clutter.floor_lamp(rng)),
        single("carton", clutter.carton(rng)),
        single("picture", clutter.painting(rng), z=1.35, hung=True),
        single("picture", clutter.painting(rng), z=1.4, hung=True),
    ]
    cupboard = single("cupboard", clutter.cupboard(rng))
    main: list[Group]
    if kind is RoomKind.STUDIO:
        main = [groups.bed_group(rng), groups.couch_group(rng), groups.tv_group(rng), groups.dining_group(rng)]
        main += [groups.kitchen_group(rng), groups.toilet_group(rng), door, window, bag, *extras]
    elif kind is RoomKind.LIVING_ROOM:
        main = [groups.couch_group(rng), groups.tv_group(rng), groups.dining_group(rng), door, window, cupboard, bag]
        main += [single("pouf", clutter.pouf(rng)), *extras]
    elif kind is RoomKind.BEDROOM:
        main = [groups.bed_group(rng), groups.desk_group(rng), door, window, cupboard, bag, *extras]
    elif kind is RoomKind.KITCHEN:
        main = [groups.dining_group(rng), groups.kitchen_group(rng), door, window, bag, cupboard, *extras]
    else:
        second = replace(groups.desk_group(rng), name="desk 2")
        main = [groups.desk_group(rng), second, single("couch", seating.couch(rng)), door, window, cupboard, bag]
        main += extras
    return main


def shell_of(width: float, depth: float, rng: Rng, doorways: Mapping[int, Sequence[float]] = NO_DOORWAYS) -> Furniture:
    """Return the floor, the ceiling and the walls of a room.

    Args:
        width: The width of the room, m.
        depth: The depth of the room, m.
        rng: The random number generator.
        doorways: The offsets of the doorways from the middle of each wall, m, by wall as in `place_on_wall`.
    """
    shell = Furniture("shell")
    shell.add(panel(width, depth).turned("x", np.pi / 2), _floor(rng), y=depth / 2)
    ceiling = panel(width, depth).turned("x", -np.pi / 2).moved(y=-depth / 2, z=HEIGHT)
    shell.add(ceiling, paints.paint(rng, (0.93, 0.92, 0.89), 0.93, 0.12))
    color = paints.pick(rng, paints.WALLS)
    plain, pattern = paints.paint(rng, color, 0.88), paints.new_seed(rng)
    paper = Material(Texture.WALLPAPER, color, paints.shade(color, 0.78), rng.uniform(0.13, 0.2), seed=pattern)
    papered, skirting = int(rng.integers(4)), paints.wood(rng)
    for wall in range(4):
        length = width if wall % 2 == 0 else depth
        x, y, angle = place_on_wall(wall, 0.0, width, depth)
        openings = sorted(doorways.get(wall, ()))
        for low, high, base in _wall_pieces(length, openings):
            piece = panel(high - low, HEIGHT - base).moved((low + high) / 2, z=base)
            piece = replace(piece, texture=piece.texture + np.array([length / 2 - high, base, 0.0]))
            shell.add(piece.turned("z", angle), paper if wall == papered else plain, x, y)
            if base == 0:
                board = rounded_box(high - low, 0.012, 0.08, 0.004).moved((low + high) / 2, y=0.006, z=0.04)
                shell.add(board.turned("z", angle), skirting, x, y)
    return shell


def _wall_pieces(length: float, doorways: Sequence[float]) -> list[tuple[float, float, float]]:
    """Return the ends along a wall and the height of the base of each rectangle of a wall with doorways, m.

    Args:
        length: The length of the wall, m.
        doorways: The offsets of the doorways from the middle of the wall, m, in ascending order.
    """
    above = [(middle - DOORWAY[0] / 2, middle + DOORWAY[0] / 2, DOORWAY[1]) for middle in doorways]
    ends = [-length / 2, *(end for low, high, _ in above for end in (low, high)), length / 2]
    return [*((low, high, 0.0) for low, high in zip(ends[::2], ends[1::2], strict=True)), *above]


def _floor(rng: Rng) -> Material:
    style = rng.uniform()
    if style < 0.65:
        first, second = paints.WOODS[int(rng.integers(len(paints.WOODS)))]
        return Material(Texture.PLANKS, first, second, rng.uniform(0.11, 0.17), seed=paints.new_seed(rng))
    if style < 0.85:
        tone = paints.pick(rng, ((0.72, 0.66, 0.58), (0.60, 0.61, 0.62), (0.76, 0.52, 0.38)))
        return Material(
            Texture.TILES, tone, paints.shade(tone, 0.6), rng.uniform(0.28, 0.42), seed=paints.new_seed(rng)
        )
    return paints.cloth(rng, paints.pick(rng, paints.CLOTHS))


def lamps_of(pieces: list[Furniture]) -> list[Lamp]:
    """Return the light sources of all objects that emit light."""
    lamps: list[Lamp] = []
    for piece in pieces:
        low, high = piece.bounds()
        center = (low + high) / 2
        if piece.kind == "ceiling lamp":
            lamps.append(globe(np.array([*center[:2], HEIGHT - 0.22]), 0.24, _scaled(WARM, 9.0), 24))
        elif piece.kind in ("floor lamp", "table lamp"):
            strength, below = (3.0, 0.10) if piece.kind == "floor lamp" else (0.9, 0.08)
            # sample points are outside the lampshade, because the shade would block the light
            lamps.append(
                globe(np.array([*center[:2], high[2] - below]), 0.24 if strength > 1 else 0.16, _scaled(WARM, strength))
            )
        elif piece.kind == "window":
            lamps.append(_daylight(low, high))
    return lamps


def _daylight(low: Float64, high: Float64) -> Lamp:
    """Return the light source of a window with the bounding box from `low` (3,) to `high` (3,), m."""
    thin = int(np.argmin((high - low)[:2]))
    wide = 1 - thin
    normal = np.zeros(3)
    normal[thin] = -np.sign((low + high)[thin])
    along, up = np.zeros(3), np.zeros(3)
    along[wide], up[2] = 0.52 * (high - low)[wide], 1.0
    corner = (low + high) / 2 - along / 2
    corner[thin] = (high if normal[thin] > 0 else low)[thin] + 0.02 * normal[thin]
    corner[2] = high[2] - 1.40
    return rectangle(corner, along, up, normal, _scaled(DAY, 16.0))


def _scaled(color: tuple[float, float, float], power: float) -> tuple[float, float, float]:
    return color[0] * power, color[1] * power, color[2] * power
