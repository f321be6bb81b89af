"""The paper's hard cases as groups: beds and couches with things lying on them, and rows of equal objects."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import clutter, fixtures, seating, soft_things, tables
from framework.synthetic.groups import (
    Group,
    against_wall,
    bed_group,
    beside,
    couch_group,
    put_on,
    size,
)
from framework.synthetic.piece import Furniture, Rng

PILLOWS = 0.68  # m, from the wall to where a bed is free to lie on
BACKREST = 0.48  # m, from the wall to where a couch is free to sit on
BORDER = 0.06  # m, of a bed or a couch on which nothing lies
ARM = 0.24  # m, the widest arm of a couch
SINK = 0.012  # m, how deep things lie in what is soft
PLACES = 60  # tried for each thing that lies about


def cluttered_bed_group(rng: Rng) -> Group:
    """A bed that somebody lives on: a blanket, clothes, cushions, a bag, books."""
    group = bed_group(rng)
    bed = group.pieces[0]
    low, high = bed.bounds()
    things = [
        soft_things.blanket(rng, rng.uniform(0.75, 0.95) * min(size(bed)[0], 1.2), rng.uniform(0.55, 0.7)),
        fixtures.backpack(rng).tilted(np.pi / 2),
        soft_things.clothes(rng),
        soft_things.throw_cushion(rng),
        tables.book_pile(rng),
        soft_things.throw_cushion(rng),
        tables.book(rng),
    ]
    _scatter(group, bed, low[:2] + (BORDER, PILLOWS), high[:2] - BORDER, rng, things)
    return group


def cluttered_couch_group(rng: Rng) -> Group:
    """A couch with its low table, on which cushions, a blanket, a bag and books lie."""
    group = couch_group(rng)
    _clutter_couch(group, rng)
    return group


def cluttered_couch(rng: Rng) -> Group:
    """The same couch without a table."""
    group = Group("couch")
    couch = seating.couch(rng)
    group.add(couch, y=against_wall(couch))
    _clutter_couch(group, rng)
    return group


def _clutter_couch(group: Group, rng: Rng) -> None:
    couch = group.pieces[0]
    low, high = couch.bounds()
    low_free, high_free = low[:2] + (ARM, BACKREST), high[:2] - (ARM, BORDER)
    seat = _height(_vertices([couch]), low_free, high_free) - SINK
    for x in np.linspace(low_free[0] + 0.3, high_free[0] - 0.3, 2):  # leaning on the back
        leaning = soft_things.throw_cushion(rng).tilted(np.pi / 2 + 0.35)
        group.add(leaning, x + rng.uniform(-0.08, 0.08), low_free[1] + 0.06, seat, rng.uniform(-0.15, 0.15))
    things = [
        soft_things.blanket(rng, rng.uniform(0.55, 0.75), rng.uniform(0.34, 0.40)),
        fixtures.backpack(rng).tilted(np.pi / 2),
        tables.book(rng),
        soft_things.throw_cushion(rng),
        tables.book_pile(rng),
    ]
    _scatter(group, couch, low_free + (0.0, 0.06), high_free, rng, things)


def _scatter(group: Group, support: Furniture, low: Float64, high: Float64, rng: Rng, things: list[Furniture]) -> None:
    """Lays things on `support` between the corners `low` and `high` (2,), m, on each other only for want of room."""
    lying = [support]
    for thing in things:
        places = [_random_place(thing, low, high, rng) for _ in range(PLACES)]
        overlaps = [sum(_overlap(place, other) for other in lying[1:]) for place in places]
        place = places[int(np.argmin(overlaps))]
        box_low, box_high = place.bounds()
        z = _height(_vertices(lying), box_low[:2], box_high[:2])
        lying.append(group.add(place, z=z - SINK))


def _random_place(thing: Furniture, low: Float64, high: Float64, rng: Rng) -> Furniture:
    turned = thing.placed(0.0, 0.0, 0.0, rng.uniform(-0.5, 0.5) + np.pi * int(rng.integers(2)))
    turned_low, turned_high = turned.bounds()
    middle = (turned_low + turned_high)[:2] / 2
    free = np.maximum((high - low - (turned_high - turned_low)[:2]) / 2, 0)
    x, y = (low + high) / 2 - middle + rng.uniform(-1, 1, 2) * free
    return turned.placed(float(x), float(y))


def _overlap(piece: Furniture, other: Furniture) -> float:
    """The area (m2) that two pieces' boxes share, seen from above."""
    (low, high), (other_low, other_high) = piece.bounds(), other.bounds()
    shared = np.minimum(high, other_high)[:2] - np.maximum(low, other_low)[:2]
    return float(np.prod(np.maximum(shared, 0)))


def _vertices(pieces: list[Furniture]) -> Float64:
    return np.concatenate([solid.vertices for piece in pieces for solid, _ in piece.parts])


def _height(vertices: Float64, low: Float64, high: Float64) -> float:
    """The greatest height among the vertices (V, 3) between the corners `low` and `high` (2,), m."""
    within = ((vertices[:, :2] >= low) & (vertices[:, :2] <= high)).all(axis=1)
    return float(vertices[within, 2].max())


def chair_row(rng: Rng, count: int) -> Group:
    """Equal chairs along the wall, nearly touching each other."""
    group = Group("chair row")
    chair = seating.chair(rng)
    pitch = size(chair)[0] + rng.uniform(0.015, 0.05)
    for k in range(count):
        group.add(chair, (k - (count - 1) / 2) * pitch, against_wall(chair))
    return group


def desk_row(rng: Rng, count: int) -> Group:
    """Equal desks side by side, each with the same office chair, and other things on each."""
    group = Group("desk row")
    desk, chair = tables.desk(rng), seating.office_chair(rng)
    pitch = size(desk)[0] + rng.uniform(0.01, 0.04)
    for k in range(count):
        x = (k - (count - 1) / 2) * pitch
        placed = group.add(desk, x, against_wall(desk))
        put_on(group, placed, rng, [clutter.table_lamp(rng), tables.book(rng), tables.book_pile(rng)])
        turned = chair.placed(0, 0, 0, np.pi + rng.uniform(-0.4, 0.4))
        y = float(placed.bounds()[1][1] - turned.bounds()[0][1]) + 0.03
        group.add(turned, x + rng.uniform(-0.1, 0.1), y)
    return group


def board_group(rng: Rng) -> Group:
    """A low board full of books, a bag beside it."""
    group = Group("board")
    board = clutter.low_board(rng)
    board = group.add(board, y=against_wall(board))
    put_on(group, board, rng, [tables.book_pile(rng), tables.book(rng), clutter.vase(rng), tables.book_pile(rng)])
    bag = fixtures.backpack(rng)
    group.add(bag, beside(bag, board, 1, 0.05), against_wall(bag))
    return group
