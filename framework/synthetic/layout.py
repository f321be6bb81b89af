"""Where furniture stands: groups against walls, nothing inside anything else, room left to walk.

Groups (a bed with its nightstand, a table with its chairs) are made about the origin facing +y, like single pieces, and
are tried at random places along the walls. Of several complete layouts the one with most room to walk is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from framework.data import Float64
from framework.errors import DataError
from framework.synthetic import clutter, furniture
from framework.synthetic.furniture import Furniture, Rng

WALL_GAP = 0.015  # m, between a wall and what stands against it
CLEARANCE = 0.06  # m, between groups
LAYOUTS = 40  # complete layouts to choose from
TRIES = 60  # places tried for each group
CELL = 0.05  # m, of the grid on which free floor is measured


@dataclass
class Group:
    """Pieces that belong together, in a common local frame: back at y = 0, facing +y."""

    name: str
    pieces: list[Furniture] = field(default_factory=list)
    hung: bool = False  # on the wall, above the floor: takes wall, not floor
    opposite: str = ""  # name of a group that it should face

    def add(self, piece: Furniture, x: float = 0.0, y: float = 0.0, z: float = 0.0, angle: float = 0.0) -> Furniture:
        placed = piece.placed(x, y, z, angle)
        self.pieces.append(placed)
        return placed

    def placed(self, x: float, y: float, angle: float) -> Group:
        return Group(self.name, [p.placed(x, y, 0.0, angle) for p in self.pieces], self.hung, self.opposite)

    def boxes(self) -> Float64:
        """The pieces' axis-aligned boxes (N, 2, 3), m."""
        return np.array([piece.bounds() for piece in self.pieces])


def against_wall(piece: Furniture) -> float:
    """The y at which the piece's back touches the plane y = 0."""
    return WALL_GAP - float(piece.bounds()[0][1])


def on_top(piece: Furniture) -> float:
    """The height of the piece's uppermost point, m."""
    return float(piece.bounds()[1][2]) + 0.001


def size(piece: Furniture) -> Float64:
    low, high = piece.bounds()
    return high - low


def bed_group(rng: Rng) -> Group:
    group = Group("bed")
    bed = furniture.bed(rng)
    bed = group.add(bed, y=against_wall(bed))
    half = size(bed)[0] / 2
    side = 1 if rng.uniform() < 0.5 else -1
    stand = clutter.nightstand(rng)
    stand = group.add(stand, side * (half + size(stand)[0] / 2 + 0.06), against_wall(stand))
    low, high = stand.bounds()
    x, y = (low + high)[:2] / 2
    group.add(clutter.table_lamp(rng), x - 0.07, y - 0.02, on_top(stand))
    group.add(furniture.book(rng), x + 0.10, y + 0.04, on_top(stand), np.pi + rng.uniform(-0.3, 0.3))
    return group


def couch_group(rng: Rng) -> Group:
    group = Group("couch")
    couch = furniture.couch(rng)
    couch = group.add(couch, y=against_wall(couch))
    front = couch.bounds()[1][1]
    low_table = furniture.coffee_table(rng)
    low_table = group.add(low_table, rng.uniform(-0.1, 0.1), front + 0.33 + size(low_table)[1] / 2)
    _set(group, low_table, rng, [furniture.book(rng), clutter.mug(rng), furniture.book_pile(rng)])
    rug = clutter.rug(rng, size(couch)[0] + 0.3, 1.5)
    group.add(rug, 0.0, front + 0.60)
    return group


def _set(group: Group, table: Furniture, rng: Rng, things: list[Furniture]) -> None:
    """Puts things on a table, side by side along its length."""
    low, high = table.bounds()
    slots = np.linspace(low[0], high[0], len(things) + 1)
    for thing, left, right in zip(things, slots[:-1], slots[1:], strict=True):
        room = np.maximum([right - left, high[1] - low[1]] - size(thing)[:2] - 0.05, 0) / 2
        x = (left + right) / 2 + rng.uniform(-0.8, 0.8) * room[0]
        y = (low[1] + high[1]) / 2 + rng.uniform(-0.8, 0.8) * room[1]
        turn = rng.uniform(-0.3, 0.3) if min(room) > 0.05 else 0.0
        group.add(thing, x, y, on_top(table), turn + (np.pi if thing.class_name == "book" else 0.0))


def tv_group(rng: Rng) -> Group:
    group = Group("tv", opposite="couch")
    board = clutter.low_board(rng)
    board = group.add(board, y=against_wall(board))
    group.add(furniture.tv(rng), 0.0, float(board.bounds()[:2][0][1] + board.bounds()[1][1]) / 2 - 0.03, on_top(board))
    if rng.uniform() < 0.6:
        plant = clutter.plant(rng)
        group.add(plant, size(board)[0] / 2 + size(plant)[0] / 2 + 0.08, against_wall(plant))
    return group


def dining_group(rng: Rng) -> Group:
    """A table with chairs on two or three sides, two of them side by side and nearly touching."""
    group = Group("dining")
    table = furniture.dining_table(rng)
    group.add(table, y=against_wall(table) + 0.03)
    table = group.pieces[0]
    low, high = table.bounds()
    make = int(rng.integers(2**31))
    chairs = [furniture.chair(np.random.default_rng(make)) for _ in range(4)]  # a set: all alike
    width = size(chairs[0])[0]
    gap = rng.uniform(0.012, 0.05)
    is_round = table.kind == "round table"
    reach = 0.0 if not is_round else 0.03
    for side, piece in zip((-1, 1), chairs[:2], strict=True):  # both look at the wall, over the table
        chair = piece.placed(0, 0, 0, np.pi)
        y = high[1] - chair.bounds()[0][1] + 0.02 + reach
        group.add(chair, side * (width + gap) / 2, y)
    for side, piece in zip((-1, 1), chairs[2:], strict=True):
        if rng.uniform() < 0.75:
            chair = piece.placed(0, 0, 0, side * np.pi / 2)  # +y turned to -x (side 1) or +x
            x = (
                high[0] - chair.bounds()[0][0] + rng.uniform(0.02, 0.10)
                if side > 0
                else low[0] - chair.bounds()[1][0] - rng.uniform(0.02, 0.10)
            )
            group.add(chair, x, (low[1] + high[1]) / 2 + rng.uniform(-0.05, 0.05))
    things = [
        furniture.book(rng),
        clutter.bowl(rng) if rng.uniform() < 0.5 else clutter.vase(rng),
        furniture.backpack(rng),
    ]
    if is_round:
        things = [things[1]]
    _set(group, table, rng, things)
    return group


def kitchen_group(rng: Rng) -> Group:
    group = Group("kitchen")
    fridge, row = furniture.refrigerator(rng), clutter.counter(rng)
    side = 1 if rng.uniform() < 0.5 else -1
    row = group.add(row, y=against_wall(row))
    group.add(fridge, side * (size(row)[0] / 2 + size(fridge)[0] / 2 + 0.03), against_wall(fridge))
    return group


def toilet_group(rng: Rng) -> Group:
    group = Group("toilet")
    toilet, wall = furniture.toilet(rng), clutter.partition(rng)
    group.add(toilet, y=against_wall(toilet))
    side = 1 if rng.uniform() < 0.5 else -1
    group.add(wall, side * 0.52, against_wall(wall))
    return group


def desk_group(rng: Rng) -> Group:
    group = Group("desk")
    desk = furniture.desk(rng)
    desk = group.add(desk, y=against_wall(desk))
    _set(group, desk, rng, [clutter.table_lamp(rng), furniture.book(rng), furniture.book_pile(rng)])
    chair = furniture.office_chair(rng).placed(0, 0, 0, np.pi + rng.uniform(-0.4, 0.4))
    group.add(chair, rng.uniform(-0.2, 0.2), desk.bounds()[1][1] - chair.bounds()[0][1] + 0.03)
    return group


def single(name: str, piece: Furniture, z: float = 0.0, hung: bool = False) -> Group:
    group = Group(name, hung=hung)
    group.add(piece, y=against_wall(piece) if not hung else 0.002, z=z)
    return group


@dataclass(frozen=True)
class Layout:
    groups: list[Group]
    free: Float64  # (rows, columns) m to the nearest obstacle or wall, for each cell of the floor
    widest: float  # m, the largest of `free`


def arrange(groups: list[Group], width: float, depth: float, rng: Rng) -> Layout:
    """The groups placed in a room of width (x) times depth (y) m about the origin, the first of them first.

    Raises DataError when the room is too small for them.
    """
    best: Layout | None = None
    for _ in range(LAYOUTS):
        placed = _try_layout(groups, width, depth, rng)
        if placed is None:
            continue
        free = free_floor(placed, width, depth)
        if best is None or free.max() > best.widest:
            best = Layout(placed, free, float(free.max()))
    if best is None:
        raise DataError(
            f"synthetic room: {len(groups)} groups of furniture do not fit into {width:.1f} x {depth:.1f} m"
        )
    return best


def _try_layout(groups: list[Group], width: float, depth: float, rng: Rng) -> list[Group] | None:
    placed: list[Group] = []
    taken = np.zeros((0, 2, 3))
    walls: dict[str, tuple[int, float]] = {}
    for group in groups:
        boxes = group.boxes()
        for _ in range(TRIES):
            wall = int(rng.integers(4))
            length = width if wall % 2 == 0 else depth
            low, high = boxes[:, 0, 0].min(), boxes[:, 1, 0].max()
            if high - low > length - 0.1:
                continue
            along = rng.uniform(-length / 2 + 0.05 - low, length / 2 - 0.05 - high)
            if group.opposite in walls:
                other, where = walls[group.opposite]
                wall, along = (
                    (other + 2) % 4,
                    float(np.clip(-where + rng.normal(0, 0.3), -length / 2 + 0.05 - low, length / 2 - 0.05 - high)),
                )
            candidate = group.placed(*_on_wall(wall, along, width, depth))
            new = candidate.boxes()
            if _overlaps(_solid(candidate, new), taken) or not _inside(new, width, depth):
                continue
            placed.append(candidate)
            taken = np.concatenate([taken, _solid(candidate, new)])
            walls[group.name] = (wall, along)
            break
        else:
            return None
    return placed


def _solid(group: Group, boxes: Float64) -> Float64:
    """The boxes that others must not enter: rugs do not count, and before what hangs nothing tall may stand."""
    return np.asarray(boxes[[piece.kind != "rug" for piece in group.pieces]])


def _on_wall(wall: int, along: float, width: float, depth: float) -> tuple[float, float, float]:
    """The place (x, y, angle) of a group `along` a wall: 0 at -y, 1 at +x, 2 at +y, 3 at -x."""
    if wall == 0:
        return along, -depth / 2, 0.0
    if wall == 1:
        return width / 2, along, np.pi / 2
    if wall == 2:
        return -along, depth / 2, np.pi
    return -width / 2, -along, -np.pi / 2


def _overlaps(new: Float64, taken: Float64) -> bool:
    if not len(taken):
        return False
    a, b = new[:, None], taken[None]
    apart = (a[..., 0, :] > b[..., 1, :] + CLEARANCE) | (b[..., 0, :] > a[..., 1, :] + CLEARANCE)
    return bool((~apart.any(axis=-1)).any())


def _inside(boxes: Float64, width: float, depth: float) -> bool:
    half = np.array([width, depth]) / 2
    return bool((boxes[:, 0, :2] > -half - 1e-6).all() and (boxes[:, 1, :2] < half + 1e-6).all())


def free_floor(groups: list[Group], width: float, depth: float) -> Float64:
    """For each CELL x CELL of the floor (rows along y, columns along x), the distance in m to furniture or walls."""
    rows, columns = round(depth / CELL), round(width / CELL)
    free = np.zeros((rows + 2, columns + 2), np.uint8)
    free[1:-1, 1:-1] = 1
    for group in groups:
        for low, high in _solid(group, group.boxes()):
            if low[2] > 1.9:
                continue
            c0, c1 = (int(np.floor((x + width / 2) / CELL)) + 1 for x in (low[0], high[0]))
            r0, r1 = (int(np.floor((y + depth / 2) / CELL)) + 1 for y in (low[1], high[1]))
            free[max(r0, 0) : r1 + 1, max(c0, 0) : c1 + 1] = 0
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.maximum(distance.astype(np.float64) - 0.5, 0) * CELL
