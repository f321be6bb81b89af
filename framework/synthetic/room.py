"""A furnished room: shell, furniture and lamps. World axes: x and y along the walls, z up, origin amid the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from framework.data import Float64
from framework.synthetic import clutter, furniture, layout, palette
from framework.synthetic.furniture import Furniture, Rng
from framework.synthetic.layout import Group, Layout, single
from framework.synthetic.lights import Lamp, globe, rectangle
from framework.synthetic.solids import Solid, panel
from framework.synthetic.surfaces import Surfaces, assemble
from framework.synthetic.textures import Material, Texture

HEIGHT = 2.55  # m
WARM, DAY = (1.0, 0.86, 0.66), (0.86, 0.94, 1.0)  # linear colour of lamps and of daylight


class RoomKind(StrEnum):
    """What a room is for. A studio holds all nine classes."""

    STUDIO = "studio"
    LIVING_ROOM = "living_room"
    BEDROOM = "bedroom"
    KITCHEN = "kitchen"
    OFFICE = "office"


@dataclass(frozen=True)
class Room:
    """One room, complete."""

    kind: RoomKind
    width: float  # m along x
    depth: float  # m along y
    objects: tuple[tuple[int, Furniture], ...]  # (instance id, piece); 0 = shell
    lamps: tuple[Lamp, ...]
    layout: Layout
    surfaces: Surfaces  # the exact triangles of all that


def furnish(kind: RoomKind, rng: Rng) -> Room:
    """A room of this kind, drawn at random."""
    groups = _groups(kind, rng)
    lengths = {RoomKind.STUDIO: (6.4, 5.6), RoomKind.LIVING_ROOM: (5.4, 4.8), RoomKind.BEDROOM: (4.9, 4.3)}
    width, depth = (side + rng.uniform(-0.15, 0.25) for side in lengths.get(kind, (4.9, 4.5)))
    plan = layout.arrange(groups, width, depth, rng)
    pieces = [piece for group in plan.groups for piece in group.pieces]
    bulb = clutter.ceiling_lamp(rng).placed(rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), HEIGHT)
    pieces.append(bulb)
    objects = [(0, piece) for piece in _shell(width, depth, rng)]
    objects += list(enumerate(pieces, start=1))
    return Room(kind, width, depth, tuple(objects), tuple(_lamps(pieces)), plan, assemble(objects))


def _groups(kind: RoomKind, rng: Rng) -> list[Group]:
    """What the room holds, largest first: the first ones find a place most easily."""
    door, window = single("door", clutter.door(rng)), single("window", clutter.window(rng), z=0.95, hung=True)
    bag = single("backpack", furniture.backpack(rng))
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
        main = [layout.bed_group(rng), layout.couch_group(rng), layout.tv_group(rng), layout.dining_group(rng)]
        main += [layout.kitchen_group(rng), layout.toilet_group(rng), door, window, bag, *extras]
    elif kind is RoomKind.LIVING_ROOM:
        main = [layout.couch_group(rng), layout.tv_group(rng), layout.dining_group(rng), door, window, cupboard, bag]
        main += [single("pouf", clutter.pouf(rng)), *extras]
    elif kind is RoomKind.BEDROOM:
        main = [layout.bed_group(rng), layout.desk_group(rng), door, window, cupboard, bag, *extras]
    elif kind is RoomKind.KITCHEN:
        main = [layout.dining_group(rng), layout.kitchen_group(rng), door, window, bag, cupboard, *extras]
    else:
        second = replace(layout.desk_group(rng), name="desk 2")
        main = [layout.desk_group(rng), second, single("couch", furniture.couch(rng)), door, window, cupboard, bag]
        main += extras
    return main


def _shell(width: float, depth: float, rng: Rng) -> list[Furniture]:
    """Floor, ceiling and four walls with skirting boards."""
    shell = Furniture("shell", None)
    floor_panel = panel(width, depth).turned("x", -np.pi / 2).turned("z", np.pi)
    floor_material = _floor(rng)
    shell.add(_upwards(width, depth), floor_material)
    ceiling = palette.paint(rng, (0.93, 0.92, 0.89), 0.93, 0.12)
    shell.add(
        floor_panel.moved(y=-depth / 2).turned("x", np.pi).moved(z=HEIGHT) if False else _downwards(width, depth),
        ceiling,
    )
    color = palette.pick(rng, palette.WALLS)
    papered, plain = int(rng.integers(4)), palette.paint(rng, color, 0.88, 0.10)
    paper = Material(
        Texture.WALLPAPER, color, palette.shade(color, 0.78), rng.uniform(0.13, 0.2), seed=int(rng.integers(4096))
    )
    skirting = palette.wood(rng)
    from framework.synthetic.solids import rounded_box

    for wall in range(4):
        length = width if wall % 2 == 0 else depth
        x, y, angle = layout._on_wall(wall, 0.0, width, depth)
        face = panel(length, HEIGHT)
        shell.add(face.turned("z", angle).moved(x, y), paper if wall == papered else plain)
        board = rounded_box(length, 0.012, 0.08, 0.004).moved(y=0.006, z=0.04)
        shell.add(board.turned("z", angle).moved(x, y), skirting)
    return [shell]


def _upwards(width: float, depth: float) -> Solid:
    """The floor: faces +z, texture (x, y) in metres."""
    return panel(width, depth).turned("x", np.pi / 2).moved(y=depth / 2)


def _downwards(width: float, depth: float) -> Solid:
    """The ceiling: faces -z."""
    return panel(width, depth).turned("x", -np.pi / 2).moved(y=-depth / 2, z=HEIGHT)


def _floor(rng: Rng) -> Material:
    style = rng.uniform()
    if style < 0.65:
        first, second = palette.WOODS[int(rng.integers(len(palette.WOODS)))]
        return Material(Texture.PLANKS, first, second, rng.uniform(0.11, 0.17), seed=int(rng.integers(4096)))
    if style < 0.85:
        tone = palette.pick(rng, ((0.72, 0.66, 0.58), (0.60, 0.61, 0.62), (0.76, 0.52, 0.38)))
        return Material(
            Texture.TILES, tone, palette.shade(tone, 0.6), rng.uniform(0.28, 0.42), seed=int(rng.integers(4096))
        )
    return palette.cloth(rng, palette.pick(rng, palette.CLOTHS))


def _lamps(pieces: list[Furniture]) -> list[Lamp]:
    """The light of everything that glows."""
    lamps: list[Lamp] = []
    for piece in pieces:
        low, high = piece.bounds()
        center = (low + high) / 2
        if piece.kind == "ceiling lamp":
            lamps.append(globe(np.array([*center[:2], HEIGHT - 0.22]), 0.24, _scaled(WARM, 9.0), 24))
        elif piece.kind in ("floor lamp", "table lamp"):
            strength, below = (3.0, 0.10) if piece.kind == "floor lamp" else (0.9, 0.08)
            # Sample points lie outside the shade, else it would swallow its own light.
            lamps.append(
                globe(np.array([*center[:2], high[2] - below]), 0.24 if strength > 1 else 0.16, _scaled(WARM, strength))
            )
        elif piece.kind == "window":
            lamps.append(_daylight(low, high))
    return lamps


def _daylight(low: Float64, high: Float64) -> Lamp:
    """A window's light, sent from between its curtains; the window lies against the wall nearest to it."""
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
