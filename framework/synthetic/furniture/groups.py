"""Furniture groups, such as a table with chairs.

The back of a group is at y = 0, and the group faces +y.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.data import Bool, Float64
from framework.synthetic.furniture import clutter, fixtures, seating, tabletops
from framework.synthetic.furniture.piece import Furniture, Rng

Place = tuple[float, float, float]  # x, y (m) and angle (rad, counterclockwise as seen from above)

WALL_GAP = 0.015  # m, gap between a wall and adjacent furniture


@dataclass
class Group:
    """Pieces of furniture that are placed together."""

    name: str
    pieces: list[Furniture] = field(default_factory=list)
    opposite: str = ""  # name of the preferred group on the opposite wall

    def add(self, piece: Furniture, x: float = 0.0, y: float = 0.0, z: float = 0.0, angle: float = 0.0) -> Furniture:
        placed = piece.placed(x, y, z, angle)
        self.pieces.append(placed)
        return placed

    def placed(self, x: float, y: float, angle: float) -> Group:
        return Group(self.name, [p.placed(x, y, 0.0, angle) for p in self.pieces], self.opposite)

    @property
    def boxes(self) -> Float64:
        """Axis-aligned bounding boxes (N, 2, 3) of the objects, m."""
        return np.array([piece.bounds() for piece in self.pieces])

    @property
    def solid(self) -> Bool:
        """Mask (N,) of all objects except rugs."""
        return np.array([piece.kind != "rug" for piece in self.pieces])


def against_wall(piece: Furniture) -> float:
    """Return the y offset, m, at which an object almost touches the wall at y = 0."""
    return WALL_GAP - float(piece.bounds()[0][1])


def on_top(piece: Furniture) -> float:
    """Return the height, m, at which objects are placed on a piece of furniture."""
    return float(piece.bounds()[1][2]) + 0.001


def size(piece: Furniture) -> Float64:
    """Return the size (3,), m, of an object."""
    low, high = piece.bounds()
    return high - low


def next_to(piece: Furniture, other: Furniture, side: int, gap: float) -> float:
    """Return the x offset, m, at which an object is next to another object.

    Args:
        piece: The object to place.
        other: The other object.
        side: 1 = the +x side, -1 = the -x side.
        gap: The gap between the objects, m.
    """
    (low, high), (other_low, other_high) = piece.bounds(), other.bounds()
    return float(other_high[0] + gap - low[0] if side > 0 else other_low[0] - gap - high[0])


def bed_group(rng: Rng) -> Group:
    """Return a random bed and a nightstand with objects."""
    group = Group("bed")
    bed = seating.bed(rng)
    bed = group.add(bed, y=against_wall(bed))
    side = 1 if rng.uniform() < 0.5 else -1
    stand = clutter.nightstand(rng)
    stand = group.add(stand, next_to(stand, bed, side, 0.06), against_wall(stand))
    put_on(group, stand, rng, [clutter.table_lamp(rng), tabletops.book(rng)][::side])
    return group


def couch_group(rng: Rng) -> Group:
    """Return a random couch with a rug and a coffee table."""
    return with_low_table(seating.couch(rng), rng)


def with_low_table(couch: Furniture, rng: Rng) -> Group:
    """Return a group with a couch, a rug and a coffee table."""
    group = Group("couch")
    couch = group.add(couch, y=against_wall(couch))
    front = couch.bounds()[1][1]
    low_table = tabletops.coffee_table(rng)
    low_table = group.add(low_table, rng.uniform(-0.1, 0.1), front + 0.33 + size(low_table)[1] / 2)
    put_on(group, low_table, rng, [tabletops.book(rng), clutter.mug(rng), tabletops.book_pile(rng)])
    rug = clutter.rug(rng, size(couch)[0] + 0.3, 1.5)
    group.add(rug, 0.0, front + 0.60)
    return group


def put_on(group: Group, table: Furniture, rng: Rng, things: list[Furniture]) -> None:
    """Place objects side by side on a table."""
    low, high = table.bounds()
    slots = np.linspace(low[0], high[0], len(things) + 1)
    for thing, left, right in zip(things, slots[:-1], slots[1:], strict=True):
        room = np.maximum([right - left, high[1] - low[1]] - size(thing)[:2] - 0.05, 0) / 2
        x = (left + right) / 2 + rng.uniform(-0.8, 0.8) * room[0]
        y = (low[1] + high[1]) / 2 + rng.uniform(-0.8, 0.8) * room[1]
        turn = rng.uniform(-0.3, 0.3) if min(room) > 0.05 else 0.0
        group.add(thing, x, y, on_top(table), turn + (np.pi if thing.class_name == "book" else 0.0))


def tv_group(rng: Rng) -> Group:
    """Return a TV on a low sideboard, sometimes with a plant."""
    group = Group("tv", opposite="couch")
    board = clutter.low_board(rng)
    board = group.add(board, y=against_wall(board))
    group.add(fixtures.tv(rng), 0.0, float(board.bounds()[:2][0][1] + board.bounds()[1][1]) / 2 - 0.03, on_top(board))
    if rng.uniform() < 0.6:
        plant = clutter.plant(rng)
        group.add(plant, next_to(plant, board, 1, 0.05), against_wall(plant))
    return group


def dining_group(rng: Rng) -> Group:
    """Return a table with two to four chairs, two of which are side by side."""
    group = Group("dining")
    table = tabletops.dining_table(rng)
    group.add(table, y=against_wall(table) + 0.03)
    table = group.pieces[0]
    low, high = table.bounds()
    make = int(rng.integers(2**31))
    chairs = [seating.chair(np.random.default_rng(make)) for _ in range(4)]  # a set of identical chairs
    width = size(chairs[0])[0]
    gap = rng.uniform(0.012, 0.05)
    is_round = table.kind == "round table"
    reach = 0.0 if not is_round else 0.03
    for side, piece in zip((-1, 1), chairs[:2], strict=True):  # both face the wall across the table
        chair = piece.placed(0, 0, 0, np.pi)
        y = high[1] - chair.bounds()[0][1] + 0.02 + reach
        group.add(chair, side * (width + gap) / 2, y)
    for side, piece in zip((-1, 1), chairs[2:], strict=True):
        if rng.uniform() < 0.75:
            chair = piece.placed(0, 0, 0, side * np.pi / 2)  # +y is rotated to -x (side 1) or +x (side -1)
            x = (
                high[0] - chair.bounds()[0][0] + rng.uniform(0.02, 0.10)
                if side > 0
                else low[0] - chair.bounds()[1][0] - rng.uniform(0.02, 0.10)
            )
            group.add(chair, x, (low[1] + high[1]) / 2 + rng.uniform(-0.05, 0.05))
    things = [
        tabletops.book(rng),
        clutter.bowl(rng) if rng.uniform() < 0.5 else clutter.vase(rng),
        fixtures.backpack(rng),
    ]
    if is_round:
        things = [things[1]]
    put_on(group, table, rng, things)
    return group


def kitchen_group(rng: Rng) -> Group:
    """Return a kitchen counter and a refrigerator next to it."""
    group = Group("kitchen")
    fridge, row = fixtures.refrigerator(rng), clutter.counter(rng)
    side = 1 if rng.uniform() < 0.5 else -1
    row = group.add(row, y=against_wall(row))
    group.add(fridge, next_to(fridge, row, side, 0.02), against_wall(fridge))
    return group


def toilet_group(rng: Rng) -> Group:
    """Return a toilet next to a partition."""
    group = Group("toilet")
    toilet, wall = fixtures.toilet(rng), clutter.partition(rng)
    group.add(toilet, y=against_wall(toilet))
    side = 1 if rng.uniform() < 0.5 else -1
    group.add(wall, side * 0.52, against_wall(wall))
    return group


def desk_group(rng: Rng) -> Group:
    """Return a desk with objects and an office chair."""
    group = Group("desk")
    desk = tabletops.desk(rng)
    desk = group.add(desk, y=against_wall(desk))
    put_on(group, desk, rng, [clutter.table_lamp(rng), tabletops.book(rng), tabletops.book_pile(rng)])
    chair = seating.office_chair(rng).placed(0, 0, 0, np.pi + rng.uniform(-0.4, 0.4))
    group.add(chair, rng.uniform(-0.2, 0.2), desk.bounds()[1][1] - chair.bounds()[0][1] + 0.03)
    return group


def single(name: str, piece: Furniture, z: float = 0.0, hung: bool = False) -> Group:
    """Return a group with one object.

    Args:
        name: The name of the group.
        piece: The object.
        z: The height of the object, m.
        hung: True = the object hangs on the wall.
    """
    group = Group(name)
    group.add(piece, y=0.002 if hung else against_wall(piece), z=z)
    return group
