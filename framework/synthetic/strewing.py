"""Things put down on the floor of a room, against its furniture, so that they touch it and hide some of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from framework.data import Float64
from framework.synthetic.furniture.groups import WALL_GAP
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.layout import WALK_RADIUS, Layout, free_floor

CONTACT = 0.003  # m, between the boxes of things that touch
PLACES = 60  # tried for each thing
ON_FLOOR = 0.05  # m, what begins lower stands on the floor
NO_HOSTS = ("door", "window", "rug")  # nothing is put down against these


def strew(layout: Layout, things: Sequence[Furniture], rng: Rng) -> Layout:
    """The layout with the things in it, each against some furniture, but for what finds no place or bars the walk.

    The things turn by quarters, so that their boxes stay as tight as they are.
    """
    for thing in things:
        layout = _with(layout, thing, rng)
    return layout


def _with(layout: Layout, thing: Furniture, rng: Rng) -> Layout:
    boxes = np.array([piece.bounds() for piece in layout.pieces])
    rugs = np.array([piece.kind == "rug" for piece in layout.pieces])
    hosts = [
        box for piece, box in zip(layout.pieces, boxes, strict=True)
        if box[0, 2] < ON_FLOOR and piece.kind not in NO_HOSTS
    ]  # fmt: skip
    half = np.array([layout.width, layout.depth]) / 2 - WALL_GAP
    for _ in range(PLACES):
        place = _against(hosts[int(rng.integers(len(hosts)))], thing, rng)
        box = np.stack(place.bounds())
        if (np.abs(box[:, :2]) > half).any() or _meets(box, boxes[~rugs]):
            continue
        free = free_floor(np.concatenate([boxes[~rugs], box[None]]), layout.width, layout.depth)
        if free.max() < WALK_RADIUS:
            continue
        under = [rug for rug in boxes[rugs] if (box[1, :2] > rug[0, :2]).all() and (box[0, :2] < rug[1, :2]).all()]
        floor = max((float(rug[1, 2]) for rug in under), default=0.0)
        return replace(layout, pieces=[*layout.pieces, place.placed(0, 0, floor)], free=free)
    return layout


def _against(host: Float64, thing: Furniture, rng: Rng) -> Furniture:
    """`thing` beside the box `host` (2, 3), at least half of it along the side that it touches."""
    turned = thing.placed(0, 0, 0, np.pi / 2 * int(rng.integers(4)))
    low, high = turned.bounds()
    axis, sign = int(rng.integers(2)), (-1 if rng.uniform() < 0.5 else 1)
    at = np.zeros(2)
    at[axis] = host[1, axis] + CONTACT - low[axis] if sign > 0 else host[0, axis] - CONTACT - high[axis]
    along = 1 - axis
    at[along] = rng.uniform(host[0, along], host[1, along]) - (low + high)[along] / 2
    return turned.placed(float(at[0]), float(at[1]))


def _meets(box: Float64, others: Float64) -> bool:
    """Whether the box (2, 3) shares space with one of the others (N, 2, 3)."""
    return bool((np.minimum(box[1], others[:, 1]) > np.maximum(box[0], others[:, 0])).all(axis=1).any())
