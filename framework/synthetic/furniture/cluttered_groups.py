"""Difficult furniture groups, with cluttered surfaces, identical objects and touching neighbors."""

from __future__ import annotations

import numpy as np

from framework.data import Float64
from framework.synthetic import paints
from framework.synthetic.furniture import clutter, fixtures, seating, small_things, tabletops
from framework.synthetic.furniture.groups import Group, against_wall, bed_group, next_to, on_top, single, size
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import SPACING
from framework.synthetic.paints import Texture

PILLOWS = 0.68  # m, distance from the wall to the part of a bed without pillows
BACKREST = 0.50  # m, distance from the wall to the part of a couch in front of its backrest
BORDER = 0.06  # m, width of the empty border of a bed or couch
ARM = 0.24  # m, maximum width of a couch arm
SINK = 0.012  # m, depth to which objects sink into soft surfaces
PLACES = 60  # maximum number of candidate positions of each scattered object
TOUCHING = (0.001, 0.005)  # m, range of the gap between touching objects, below the resolution of the sensor
LADEN_CHAIRS = 0.5  # probability that a chair of a row has an object on it
SEAT = 0.19  # m, distance from the front of a chair to the center of its seat
LEATHER_COUCHES = 0.3  # fraction of the couches that have black leather
RIM = 0.02  # m, width of the empty border of a table
APRON = 0.13  # m, height of the blocked space below a table top


def cluttered_bed_group(rng: Rng) -> Group:
    """Return a bed with a blanket, clothes, cushions, a bag and books."""
    group = bed_group(rng)
    bed, stand = group.pieces[:2]
    side = 1 if stand.bounds()[0][0] > 0 else -1
    bag = fixtures.backpack(rng).placed(0, 0, 0, -side * np.pi / 2)
    group.add(bag, next_to(bag, bed, -side, _touch(rng)), float(bed.bounds()[1][1]) - rng.uniform(0.3, 0.9))
    low, high = bed.bounds()
    things = [
        clutter.blanket(rng, rng.uniform(0.75, 0.95) * min(size(bed)[0], 1.2), rng.uniform(0.55, 0.7)),
        fixtures.backpack(rng).tilted(np.pi / 2),
        clutter.throw_cushion(rng),
        tabletops.book_pile(rng),
        clutter.clothes(rng),
        tabletops.book(rng),
        clutter.throw_cushion(rng),
    ]
    _scatter(group, [bed], low[:2] + np.array([BORDER, PILLOWS]), high[:2] - BORDER, rng, things)
    return group


def cluttered_couch_group(rng: Rng) -> Group:
    """Return a cluttered couch and a cluttered coffee table that touch each other."""
    group = cluttered_couch(rng)
    front = float(group.pieces[0].bounds()[1][1])
    table = tabletops.coffee_table(rng)
    table = group.add(table, rng.uniform(-0.3, 0.3), front + _touch(rng) + size(table)[1] / 2)
    things = [tabletops.book_pile(rng), tabletops.book(rng), *small_things.some(rng, small_things.ON_TABLES, 4)]
    strew_on(group, table, rng, things)
    group.add(clutter.rug(rng, size(table)[0] + 1.2, 1.5), 0.0, front + 0.60)
    return group


def cluttered_couch(rng: Rng) -> Group:
    """Return a cluttered couch without a table."""
    group = Group("couch")
    couch = seating.bare_couch(rng)
    if rng.uniform() < LEATHER_COUCHES:
        couch = _in_leather(couch, rng)
    group.add(couch, y=against_wall(couch))
    _clutter_couch(group, rng)
    return group


def _in_leather(couch: Furniture, rng: Rng) -> Furniture:
    """Replace the fabric of a couch with black leather."""
    hide = paints.leather(rng)
    parts = [(solid, hide if material.texture is Texture.FABRIC else material) for solid, material in couch.parts]
    return Furniture(couch.kind, couch.class_name, parts)


def _clutter_couch(group: Group, rng: Rng) -> None:
    couch = group.pieces[0]
    low, high = couch.bounds()
    low_free, high_free = low[:2] + np.array([ARM, BACKREST]), high[:2] - np.array([ARM, BORDER])
    side = 1 if rng.uniform() < 0.5 else -1
    seat = _height([couch], low_free, high_free) - SINK
    leaning = clutter.throw_cushion(rng).tilted(np.pi / 2 + 0.35)
    x = (high_free[0] if side > 0 else low_free[0]) - side * size(leaning)[0] / 2
    leaning = group.add(leaning, x, low_free[1] + 0.04, seat, rng.uniform(-0.1, 0.1))
    things = [
        clutter.blanket(rng, rng.uniform(0.45, 0.65), rng.uniform(0.34, 0.40)),
        fixtures.backpack(rng).tilted(np.pi / 2),
        tabletops.book_pile(rng),
        clutter.throw_cushion(rng),
        tabletops.book(rng),
        clutter.clothes(rng),
    ]
    _scatter(group, [couch, leaning], low_free, high_free, rng, things)


def _scatter(
    group: Group, lying: list[Furniture], low: Float64, high: Float64, rng: Rng, things: list[Furniture]
) -> None:
    """Place objects at random free positions on a piece of furniture.

    Objects may overlap blankets, but not other objects. Objects without a free position are omitted.

    Args:
        group: The group to which the objects are added.
        lying: The furniture, followed by the objects that are already on it.
        low: The lower corner (2,) of the area, m.
        high: The upper corner (2,) of the area, m.
        rng: The random number generator.
        things: The objects to place.
    """
    lying = [*lying]
    in_the_way = [np.stack(piece.bounds()) for piece in lying[1:]]
    for thing in things:
        for _ in range(PLACES):
            place = _placed_at_random(thing, low, high, rng)
            box = np.stack(place.bounds())
            if any(_overlap(box, other) for other in in_the_way):
                continue
            z = _height(lying, np.maximum(box[0, :2], low), np.minimum(box[1, :2], high))
            lying.append(group.add(place, z=z - SINK))
            if thing.kind != "blanket":
                in_the_way.append(box)
            break


def _placed_at_random(thing: Furniture, low: Float64, high: Float64, rng: Rng) -> Furniture:
    """Move an object to a random position in an area and rotate it at random.

    An object that is larger than the area is centered. `low` and `high` are the corners (2,) of the area, m.
    """
    turned = thing.placed(0.0, 0.0, 0.0, np.pi / 2 * int(rng.integers(4)) + rng.uniform(-0.3, 0.3))
    turned_low, turned_high = turned.bounds()
    middle = (turned_low + turned_high)[:2] / 2
    free = np.maximum((high - low - (turned_high - turned_low)[:2]) / 2, 0)
    x, y = (low + high) / 2 - middle + rng.uniform(-1, 1, 2) * free
    return turned.placed(float(x), float(y))


def _overlap(box: Float64, other: Float64) -> bool:
    """Return True if two boxes (2, 3), m, overlap in x and y."""
    return bool((np.minimum(box[1], other[1])[:2] > np.maximum(box[0], other[0])[:2]).all())


def _height(pieces: list[Furniture], low: Float64, high: Float64) -> float:
    """Return the height, m, of the highest vertex in the area from `low` (2,) to `high` (2,), m."""
    vertices = np.concatenate([solid.vertices for piece in pieces for solid, _ in piece.parts])
    within = ((vertices[:, :2] >= low) & (vertices[:, :2] <= high)).all(axis=1)
    return float(vertices[within, 2].max())


def chair_row(rng: Rng, count: int) -> Group:
    """Return a row of identical chairs that touch each other, some with objects on them."""
    group = Group("chair row")
    chair = seating.chair(rng)
    pitch = size(chair)[0] + _touch(rng)
    for k in range(count):
        group.add(chair, (k - (count - 1) / 2) * pitch, against_wall(chair))
    for placed in group.pieces[: count - 1]:
        if rng.uniform() < LADEN_CHAIRS:
            things = [clutter.throw_cushion(rng), tabletops.book_pile(rng), clutter.clothes(rng)]
            _lay_on_seat(group, placed, things[int(rng.integers(len(things)))])
    return group


def _lay_on_seat(group: Group, chair: Furniture, thing: Furniture) -> None:
    low, high = chair.bounds()
    x, y = float(low[0] + high[0]) / 2, float(high[1]) - SEAT
    z = _height([chair], np.array([low[0], y - 0.05]), np.array([high[0], y + 0.05]))
    wide = size(thing)[:2].max()
    fit = min(1.0, 2 * SEAT / wide)
    parts = [(solid.deformed(lambda p: p * (fit, fit, 1.0)), material) for solid, material in thing.parts]
    group.add(Furniture(thing.kind, thing.class_name, parts), x, y, z - SINK)


def desk_row(rng: Rng, count: int) -> Group:
    """Return a row of identical desks that touch each other, with chairs and random objects."""
    group = Group("desk row")
    desk, chair = tabletops.desk(rng), seating.office_chair(rng)
    pitch = size(desk)[0] + _touch(rng)
    for k in range(count):
        placed = group.add(desk, (k - (count - 1) / 2) * pitch, against_wall(desk))
        push_under(group, placed, chair, rng.uniform(-0.1, 0.1))
        things = [small_things.book_row(rng), tabletops.book_pile(rng), clutter.table_lamp(rng), tabletops.book(rng)]
        strew_on(group, placed, rng, [*things, *small_things.some(rng, small_things.ON_TABLES, 4)])
    return group


def laid_table_group(rng: Rng) -> Group:
    """Return a long table with many objects and three or four identical chairs."""
    group = Group("dining")
    table = tabletops.long_table(rng)
    table = group.add(table, y=against_wall(table))
    low, high = table.bounds()
    chair = seating.chair(rng)
    pitch = size(chair)[0] + _touch(rng)
    for side in (-1, 1):
        push_under(group, table, chair, side * pitch / 2)
    for side in (-1, 1)[: int(rng.integers(1, 3))]:
        turned = chair.placed(0, 0, 0, side * np.pi / 2)
        group.add(turned, next_to(turned, table, side, _touch(rng)), float(low[1] + high[1]) / 2)
    things = [fixtures.backpack(rng), tabletops.book_pile(rng), clutter.bowl(rng), tabletops.book(rng)]
    strew_on(group, table, rng, [*things, *small_things.some(rng, small_things.ON_TABLES, 5)])
    return group


def push_under(group: Group, table: Furniture, chair: Furniture, x: float) -> Furniture:
    """Push a chair under a table until they touch, and add it to the group.

    The table faces +y. `x` is the offset of the chair from the middle of the table, m.
    """
    low, high = table.bounds()
    turned = chair.placed(0, 0, 0, np.pi)
    stopped = _between(turned, float(high[2]) - APRON, float(high[2]))
    y = float(high[1]) + TOUCHING[0] - float(stopped[:, 1].min())
    return group.add(turned, float(low[0] + high[0]) / 2 + x, y)


def _between(piece: Furniture, bottom: float, top: float) -> Float64:
    """Return the vertices (N, 3), m, of an object between two heights, m."""
    solids = [solid.vertices for solid, _ in piece.parts]
    reaching = [v for v in solids if v[:, 2].max() > bottom and v[:, 2].min() < top]
    sections = [v[(v[:, 2] > bottom - SPACING) & (v[:, 2] < top + SPACING)] for v in reaching]
    return np.concatenate(sections)


def strew_on(group: Group, table: Furniture, rng: Rng, things: list[Furniture]) -> None:
    """Place objects at random free positions on a table.

    Objects without a free position are omitted.
    """
    low, high = table.bounds()
    there: list[Float64] = []
    for thing in things:
        for _ in range(PLACES):
            place = _placed_at_random(thing, low[:2] + RIM, high[:2] - RIM, rng)
            box = np.stack(place.bounds())
            over_edge = (box[0, :2] < low[:2]).any() or (box[1, :2] > high[:2]).any()
            if over_edge or any(_overlap(box, other) for other in there):
                continue
            group.add(place, z=on_top(table))
            there.append(box)
            break


def _touch(rng: Rng) -> float:
    return float(rng.uniform(*TOUCHING))


def board_group(rng: Rng) -> Group:
    """Return a low sideboard with books and other objects, and a bag next to it."""
    group = Group("board")
    board = clutter.low_board(rng)
    board = group.add(board, y=against_wall(board))
    things = [tabletops.book_pile(rng), small_things.book_row(rng), tabletops.book_pile(rng), clutter.vase(rng)]
    things += [tabletops.book(rng), small_things.book_row(rng), *small_things.some(rng, small_things.ON_TABLES, 2)]
    strew_on(group, board, rng, things)
    bag = fixtures.backpack(rng)
    group.add(bag, next_to(bag, board, 1, _touch(rng)), against_wall(bag))
    return group


def laden(name: str, support: Furniture, rng: Rng) -> Group:
    """Return a group with a piece of furniture and objects on top."""
    group = single(name, support)
    strew_on(group, group.pieces[0], rng, small_things.some(rng, small_things.ON_TOPS, 2))
    return group
