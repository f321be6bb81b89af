"""Division of a floor plan into rooms.

A room is a part of the known floor. Rooms are separated by walls and connected by doors, i.e. openings of at most the
width DOOR. The interior of a room consists of all cells farther than half a door width from every wall. The interiors
are then grown until they meet in the doors. Furniture and unobserved areas do not separate rooms. A plan without
observed walls has one room.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import ndimage

from framework.data import Bool, Float64, Int32
from framework.exporting.occupancy import Plan

DOOR = 1.0  # m, maximum width of an opening between rooms; most doors are 0.7 to 0.95 m wide
GAP = 0.3  # maximum width of unknown gaps in the floor that are filled, m
MIN_INSIDE = 0.5  # minimum interior area of a room, m^2


@dataclass(frozen=True)
class Door:
    """An opening between two rooms."""

    rooms: tuple[int, int]  # numbers of the two rooms
    place: Float64  # (2,) m, center of the opening in the room frame
    width: float  # m


@dataclass(frozen=True)
class Rooms:
    """The rooms of a floor plan, numbered from 1 in descending order of area."""

    labels: Int32  # (H, W) room number of each cell, 0 = none
    doors: tuple[Door, ...]
    plan: Plan

    @property
    def count(self) -> int:
        return int(self.labels.max(initial=0))

    def area(self, room: int) -> float:
        """Return the area of a room, m^2."""
        return float(np.count_nonzero(self.labels == room)) * self.plan.resolution**2

    def center(self, room: int) -> Float64:
        """Return the center (2,) of a room, i.e. the mean position of its cells, m."""
        return _place(self.plan, self.labels == room)

    def of(self, xy: Float64) -> int:
        """Return the number of the room nearest to most of the points (P, 2), m, or 0 without rooms."""
        if not self.count:
            return 0
        nearest = ndimage.distance_transform_edt(self.labels == 0, return_distances=False, return_indices=True)
        rows, columns = self.plan.cells(xy).T
        found = self.labels[nearest[0][rows, columns], nearest[1][rows, columns]]
        return int(np.bincount(found).argmax())


def rooms(plan: Plan) -> Rooms:
    """Return the rooms of a floor plan."""
    known = plan.floor | plan.free | plan.occupied
    margin = int(np.ceil(GAP / plan.resolution))
    round_ = _disk(GAP / plan.resolution)
    closed = ndimage.binary_closing(np.pad(known, margin), round_)[margin:-margin, margin:-margin]
    domain = closed & ~plan.wall
    from_walls = ndimage.distance_transform_edt(~plan.wall) * plan.resolution if plan.wall.any() else np.inf
    inside, count = ndimage.label(domain & (from_walls > DOOR / 2))
    areas = np.bincount(inside.ravel(), minlength=count + 1)[1:] * plan.resolution**2
    kept = np.flatnonzero(areas >= MIN_INSIDE) + 1
    if len(kept) < 2:
        return Rooms(domain.astype(np.int32), (), plan)
    grown = _grown(np.where(np.isin(inside, kept), inside, 0).astype(np.int32), domain)
    sizes = np.bincount(grown.ravel())
    number = np.zeros(len(sizes), np.int32)
    number[sorted(kept.tolist(), key=lambda key: -int(sizes[key]))] = np.arange(1, len(kept) + 1)
    labels = number[grown]
    return Rooms(labels, _doors(labels, plan), plan)


def _grown(labels: Int32, domain: Bool) -> Int32:
    """Grow the labels (H, W) within the mask `domain` (H, W) until they meet."""
    cross = ndimage.generate_binary_structure(2, 1)
    while True:
        spread = np.where((labels == 0) & domain, ndimage.maximum_filter(labels, footprint=cross), labels)
        if np.array_equal(spread, labels):
            return labels
        labels = spread


def _doors(labels: Int32, plan: Plan) -> tuple[Door, ...]:
    """Return one door for each connected border between two rooms."""
    doors = []
    every = np.ones((3, 3), np.bool_)
    for a, b in combinations(range(1, int(labels.max()) + 1), 2):
        adjacent = (labels == a) & ndimage.binary_dilation(labels == b)
        lines, count = ndimage.label(adjacent, every)
        for k in range(1, count + 1):
            rows, columns = np.nonzero(lines == k)
            width = max(np.ptp(rows), np.ptp(columns)) + 1
            doors.append(Door((a, b), _place(plan, lines == k), float(width * plan.resolution)))
    return tuple(doors)


def _place(plan: Plan, cells: Bool) -> Float64:
    """Return the mean position (2,) of the cells in a mask (H, W), m, in the room frame."""
    rows, columns = np.nonzero(cells)
    return np.asarray((np.array([columns.mean(), rows.mean()]) + 0.5) * plan.resolution + plan.origin)


def _disk(radius: float) -> Bool:
    n = int(np.ceil(radius))
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    return np.asarray(x * x + y * y <= radius * radius)
