"""Random furniture layouts.

Groups are placed against the walls without intersections. Of several layouts, the one with the most free space for the
camera path is kept. If the space is too small, the room is enlarged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from framework.data import Float64
from framework.errors import DataError
from framework.synthetic.furniture.groups import WALL_GAP, Group, Place
from framework.synthetic.furniture.piece import Furniture, Rng
from framework.synthetic.furniture.solids import axis_rotation

CLEARANCE = 0.06  # m, minimum gap between groups
MARGIN = 0.05  # m, minimum gap between a group and the corner of the room
LAYOUTS = 16  # number of candidate layouts for each room size
TRIES = 50  # number of candidate positions of each group
GROWTH = (1.0, 1.06, 1.12, 1.2, 1.3, 1.4, 1.5)  # scale factors of the side lengths of candidate rooms
WALK_RADIUS = 1.3  # m, minimum radius of the free circle for a camera path
HEAD_ROOM = 1.9  # m, height of the base above which an object does not block the camera path
CONTACT = 0.003  # m, gap between an object on the floor and the furniture that it touches
PLACES = 60  # maximum number of candidate positions of each object on the floor
ON_FLOOR = 0.05  # m, maximum height of the base of an object that stands on the floor
NO_HOSTS = ("door", "window", "rug")  # kinds of furniture without objects next to them
CELL = 0.05  # m, cell size of the grid of free floor


@dataclass(frozen=True)
class Layout:
    """A room with placed furniture."""

    width: float  # m, along x
    depth: float  # m, along y
    pieces: list[Furniture]  # objects in the room frame: x, y along the walls, z up, origin at the center of the floor
    free: Float64  # (rows along y, columns along x) m, distance from each floor cell to the nearest object or wall


def arrange(groups: list[Group], width: float, depth: float, rng: Rng, walkway: float = 0.0) -> Layout:
    """Place furniture groups in the smallest room with space for a camera path.

    Args:
        groups: The groups.
        width: The width of the smallest room, m.
        depth: The depth of the smallest room, m.
        rng: The random number generator.
        walkway: The width of the free strip at the wall at -y, m.

    Raises:
        DataError: The groups do not fit into the largest room.
    """
    boxes = [group.boxes for group in groups]
    for factor in GROWTH:
        plans = [_try_layout(groups, boxes, factor * width, factor * depth, rng, walkway) for _ in range(LAYOUTS)]
        complete = [plan for plan in plans if plan is not None]
        if not complete:
            continue
        free = [free_floor(np.concatenate(plan.solid), factor * width, factor * depth) for plan in complete]
        best = int(np.argmax([distance.max() for distance in free]))
        if free[best].max() >= WALK_RADIUS:
            placed = [g.placed(*at) for g, at in zip(groups, complete[best].places, strict=True)]
            pieces = [piece for group in placed for piece in group.pieces]
            return Layout(factor * width, factor * depth, pieces, free[best])
    raise DataError(
        f"synthetic scene: expected a layout of {len(groups)} furniture groups, got none in {len(GROWTH) * LAYOUTS} "
        "attempts; set another seed or scene"
    )


@dataclass
class _Plan:
    places: list[Place] = field(default_factory=list)
    solid: list[Float64] = field(default_factory=list)  # (N, 2, 3) m, boxes of the solid objects of each group


def _try_layout(
    groups: list[Group], boxes_of_groups: list[Float64], width: float, depth: float, rng: Rng, walkway: float
) -> _Plan | None:
    """Return a random layout, or None if a group does not fit."""
    plan = _Plan()
    low, high = np.array([-width, -depth]) / 2, np.array([width / 2, walkway - depth / 2])
    taken = np.array([[[*low, 0.0], [*high, np.inf]]] if walkway else np.zeros((0, 2, 3)))
    walls: dict[str, tuple[int, float]] = {}
    for group, boxes in zip(groups, boxes_of_groups, strict=True):
        solid = group.solid
        low, high = boxes[:, 0, 0].min(), boxes[:, 1, 0].max()
        for _ in range(TRIES):
            wall = int(rng.integers(4))
            along = rng.uniform()
            if group.opposite in walls:
                other, where = walls[group.opposite]
                wall = (other + 2) % 4
            length = width if wall % 2 == 0 else depth
            least, most = -length / 2 + MARGIN - low, length / 2 - MARGIN - high
            if most < least:
                continue
            along = least + along * (most - least)
            if group.opposite in walls:
                along = float(np.clip(-where + rng.normal(0, 0.3), least, most))
            place = place_on_wall(wall, along, width, depth)
            turned = _turned_boxes(boxes, wall, place)
            if not _inside(turned, width, depth) or _overlap(turned[solid], taken):
                continue
            plan.places.append(place)
            plan.solid.append(turned[solid])
            taken = np.concatenate([taken, turned[solid]])
            walls[group.name] = (wall, along)
            break
        else:
            return None
    return plan


def place_on_wall(wall: int, along: float, width: float, depth: float) -> Place:
    """Return the position and angle of a group at a wall.

    Args:
        wall: The wall: 0 = -y, 1 = +x, 2 = +y, 3 = -x.
        along: The offset from the middle of the wall, m.
        width: The width of the room, m.
        depth: The depth of the room, m.
    """
    if wall == 0:
        return along, -depth / 2, 0.0
    if wall == 1:
        return width / 2, along, np.pi / 2
    if wall == 2:
        return -along, depth / 2, np.pi
    return -width / 2, -along, -np.pi / 2


def _turned_boxes(boxes: Float64, quarters: int, place: Place) -> Float64:
    """Rotate boxes (N, 2, 3), m, by quarter turns about z and move them to a place."""
    R = np.rint(axis_rotation("z", quarters * np.pi / 2))
    corners = boxes @ R.T + np.array([place[0], place[1], 0.0])
    return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _overlap(new: Float64, taken: Float64) -> bool:
    a, b = new[:, None], taken[None]
    apart = (a[..., 0, :] > b[..., 1, :] + CLEARANCE) | (b[..., 0, :] > a[..., 1, :] + CLEARANCE)
    return not bool(apart.any(axis=-1).all())


def _inside(boxes: Float64, width: float, depth: float) -> bool:
    half = np.array([width, depth]) / 2
    return bool((boxes[:, 0, :2] > -half - 1e-6).all() and (boxes[:, 1, :2] < half + 1e-6).all())


def free_floor(boxes: Float64, width: float, depth: float) -> Float64:
    """Return a lower bound, m, of the distance from each floor cell to the nearest box or wall.

    The result is a grid with one row per CELL along y and one column per CELL along x.

    Args:
        boxes: The lower and upper corners (N, 2, 3) of the boxes, m.
        width: The width of the room, m.
        depth: The depth of the room, m.
    """
    rows, columns = int(depth / CELL), int(width / CELL)
    free = np.zeros((rows + 2, columns + 2), np.uint8)
    free[1:-1, 1:-1] = 1
    for low, high in boxes[boxes[:, 0, 2] < HEAD_ROOM]:
        c0, c1 = (int(np.floor((x + width / 2) / CELL)) + 1 for x in (low[0], high[0]))
        r0, r1 = (int(np.floor((y + depth / 2) / CELL)) + 1 for y in (low[1], high[1]))
        free[max(r0, 0) : r1 + 1, max(c0, 0) : c1 + 1] = 0
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(np.maximum(distance.astype(np.float64) - 1, 0) * CELL)


def strew(layout: Layout, things: Sequence[Furniture], rng: Rng) -> Layout:
    """Place objects on the floor next to furniture.

    Objects that do not fit, or that block the camera path, are omitted.
    """
    for thing in things:
        layout = _with_thing(layout, thing, rng)
    return layout


def _with_thing(layout: Layout, thing: Furniture, rng: Rng) -> Layout:
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
    """Place an object on the floor at a random side of a box (2, 3), m."""
    turned = thing.placed(0, 0, 0, np.pi / 2 * int(rng.integers(4)))
    low, high = turned.bounds()
    axis, sign = int(rng.integers(2)), (-1 if rng.uniform() < 0.5 else 1)
    at = np.zeros(2)
    at[axis] = host[1, axis] + CONTACT - low[axis] if sign > 0 else host[0, axis] - CONTACT - high[axis]
    along = 1 - axis
    at[along] = rng.uniform(host[0, along], host[1, along]) - (low + high)[along] / 2
    return turned.placed(float(at[0]), float(at[1]))


def _meets(box: Float64, others: Float64) -> bool:
    """Return True if a box (2, 3) intersects any of the boxes (N, 2, 3)."""
    return bool((np.minimum(box[1], others[:, 1]) > np.maximum(box[0], others[:, 0])).all(axis=1).any())
