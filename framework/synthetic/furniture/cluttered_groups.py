"""The paper's hard cases as groups: beds and couches with things lying on them, and rows of equal objects."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic.furniture import clutter, fixtures, seating, soft_things, tabletops
from framework.synthetic.furniture.groups import Group, against_wall, bed_group, beside, put_on, size, with_low_table
from framework.synthetic.furniture.piece import Furniture, Rng

PILLOWS = 0.68  # m, from the wall to where a bed is free to lie on
BACKREST = 0.50  # m, from the wall to where a couch is free to sit on
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
        tabletops.book_pile(rng),
        soft_things.clothes(rng),
        soft_things.throw_cushion(rng),
        tabletops.book(rng),
        soft_things.throw_cushion(rng),
    ]
    _scatter(group, [bed], low[:2] + np.array([BORDER, PILLOWS]), high[:2] - BORDER, rng, things)
    return group


def cluttered_couch_group(rng: Rng) -> Group:
    """A couch with its low table, on which cushions, a blanket, a bag and books lie."""
    group = with_low_table(seating.bare_couch(rng), rng)
    _clutter_couch(group, rng)
    return group


def cluttered_couch(rng: Rng) -> Group:
    """The same couch without a table."""
    group = Group("couch")
    couch = seating.bare_couch(rng)
    group.add(couch, y=against_wall(couch))
    _clutter_couch(group, rng)
    return group


def _clutter_couch(group: Group, rng: Rng) -> None:
    couch = group.pieces[0]
    low, high = couch.bounds()
    low_free, high_free = low[:2] + np.array([ARM, BACKREST]), high[:2] - np.array([ARM, BORDER])
    side = 1 if rng.uniform() < 0.5 else -1
    seat = _height([couch], low_free, high_free) - SINK
    leaning = soft_things.throw_cushion(rng).tilted(np.pi / 2 + 0.35)
    x = (high_free[0] if side > 0 else low_free[0]) - side * size(leaning)[0] / 2
    leaning = group.add(leaning, x, low_free[1] + 0.04, seat, rng.uniform(-0.1, 0.1))
    things = [
        soft_things.blanket(rng, rng.uniform(0.45, 0.65), rng.uniform(0.34, 0.40)),
        fixtures.backpack(rng).tilted(np.pi / 2),
        tabletops.book_pile(rng),
        soft_things.throw_cushion(rng),
        tabletops.book(rng),
        soft_things.clothes(rng),
    ]
    _scatter(group, [couch, leaning], low_free, high_free, rng, things)


def _scatter(
    group: Group, lying: list[Furniture], low: Float64, high: Float64, rng: Rng, things: list[Furniture]
) -> None:
    """Lays things on the first piece of `lying`, between the corners `low` and `high` (2,), m.

    They lie beside the other pieces and beside each other, but on blankets. What finds no place is left out.
    """
    lying = [*lying]
    for thing in things:
        for _ in range(PLACES):
            place = _random_place(thing, low, high, rng)
            box_low, box_high = place.bounds()
            if any(_overlap(place, other) for other in lying[1:] if other.kind != "blanket"):
                continue
            z = _height(lying, np.maximum(box_low[:2], low), np.minimum(box_high[:2], high))
            lying.append(group.add(place, z=z - SINK))
            break


def _random_place(thing: Furniture, low: Float64, high: Float64, rng: Rng) -> Furniture:
    """`thing` lengthwise or across, somewhere between the corners, or amid them where it is too large for that."""
    turned = thing.placed(0.0, 0.0, 0.0, np.pi / 2 * int(rng.integers(4)) + rng.uniform(-0.3, 0.3))
    turned_low, turned_high = turned.bounds()
    middle = (turned_low + turned_high)[:2] / 2
    free = np.maximum((high - low - (turned_high - turned_low)[:2]) / 2, 0)
    x, y = (low + high) / 2 - middle + rng.uniform(-1, 1, 2) * free
    return turned.placed(float(x), float(y))


def _overlap(piece: Furniture, other: Furniture) -> bool:
    """Whether two pieces' boxes share ground, seen from above."""
    (low, high), (other_low, other_high) = piece.bounds(), other.bounds()
    return bool((np.minimum(high, other_high)[:2] > np.maximum(low, other_low)[:2]).all())


def _height(pieces: list[Furniture], low: Float64, high: Float64) -> float:
    """The height (m) of what is uppermost between the corners `low` and `high` (2,)."""
    vertices = np.concatenate([solid.vertices for piece in pieces for solid, _ in piece.parts])
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
    desk, chair = tabletops.desk(rng), seating.office_chair(rng)
    pitch = size(desk)[0] + rng.uniform(0.01, 0.04)
    for k in range(count):
        x = (k - (count - 1) / 2) * pitch
        placed = group.add(desk, x, against_wall(desk))
        put_on(group, placed, rng, [clutter.table_lamp(rng), tabletops.book(rng), tabletops.book_pile(rng)])
        turned = chair.placed(0, 0, 0, np.pi + rng.uniform(-0.4, 0.4))
        y = float(placed.bounds()[1][1] - turned.bounds()[0][1]) + 0.03
        group.add(turned, x + rng.uniform(-0.1, 0.1), y)
    return group


def board_group(rng: Rng) -> Group:
    """A low board full of books, a bag beside it."""
    group = Group("board")
    board = clutter.low_board(rng)
    board = group.add(board, y=against_wall(board))
    put_on(
        group, board, rng, [tabletops.book_pile(rng), tabletops.book(rng), clutter.vase(rng), tabletops.book_pile(rng)]
    )
    bag = fixtures.backpack(rng)
    group.add(bag, beside(bag, board, 1, 0.05), against_wall(bag))
    return group
