"""Occupancy grids of the floor for mobile robots.

A map stores voxels only near surfaces, so most of the free space is not stored. Free space is therefore computed by
rendering the surface from camera poses along the trajectory.

- A cell is free if its floor was observed and all space up to the height of the robot was observed as free.
- A cell is occupied if there is a surface in this space. Surfaces below CLEARANCE are ignored.
- All other cells are unknown.

Runs do not store the field of view of the camera. The field of view of a Kinect is assumed
(`queries.changes.ASSUMED_CAMERA`). Depth cameras do not observe glass and mirrors, which may therefore be classified as
free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from framework.data import Bool, Float64, Int32, Int64, Structure, UInt8
from framework.datasets.frames.world_offset import origin_comments
from framework.errors import DataError
from framework.exporting.upright_room import SurfacePoints, UprightRoom, surface_points
from framework.files.atomic_write import atomic_write
from framework.geometry import inverse, project, transform
from framework.queries.changes import ASSUMED_CAMERA, RENDERED_POSES
from framework.rendering.rasterizer import Rasterizer

CLEARANCE = 0.08  # ignored height above the floor, m, because floors are noisy
LEVEL_STEP = 0.1  # vertical sampling of free space, m
SLACK = 0.03  # minimum distance of a surface behind free space, m
FARTHEST = 5.0  # range of the camera, m; default of fuser.max_depth
WALL_SPAN = 1.0  # minimum height of a wall, m
MAX_CELLS = 2**24  # maximum number of cells of a floor plan


@dataclass(frozen=True)
class Plan:
    """A grid over the floor in top view. Row 0 has the lowest y, column 0 the lowest x."""

    resolution: float  # m, > 0, side of a cell
    origin: Float64  # (2,) m, lower left corner of the first cell
    occupied: Bool  # (H, W) surface between CLEARANCE and the robot height
    free: Bool  # (H, W) observed floor with free space above, up to the robot height
    floor: Bool  # (H, W) observed floor
    wall: Bool  # (H, W) vertical surface at least WALL_SPAN high
    highest: Int32  # (H, W) id of the object with the highest surface, 0 = none

    @property
    def shape(self) -> tuple[int, int]:
        return self.free.shape[0], self.free.shape[1]

    def cells(self, xy: Float64) -> Int64:
        """Return the row and column (P, 2) of points (P, 2), m, in the room frame.

        Points outside the grid get the nearest cell.
        """
        columns, rows = np.floor((xy - self.origin) / self.resolution).astype(np.int64).T
        return np.stack([np.clip(rows, 0, self.shape[0] - 1), np.clip(columns, 0, self.shape[1] - 1)], axis=1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Bounds of the grid: lowest x, highest x, lowest y, highest y, m."""
        rows, columns = self.shape
        x, y = self.origin.tolist()
        return x, x + columns * self.resolution, y, y + rows * self.resolution


def plan(room: UprightRoom, resolution: float, robot_height: float) -> Plan:
    """Return the floor plan of a room.

    Args:
        room: Room with a known floor height.
        resolution: Cell size, m.
        robot_height: Height of the robot, m.

    Raises:
        DataError: The map is empty, or the plan has more than MAX_CELLS cells.
    """
    found = surface_points(room, resolution / 2)
    if not len(found.points):
        raise DataError("map: expected a surface for the plan, got an empty map")
    low, high = found.points[:, :2].min(axis=0).astype(np.float64), found.points[:, :2].max(axis=0).astype(np.float64)
    origin = (np.floor(low / resolution) - 1) * resolution
    columns, rows = (np.floor((high - origin) / resolution) + 2).astype(np.int64).tolist()
    if rows * columns > MAX_CELLS:
        cells = f"{columns} x {rows} cells of {resolution:g} m"
        raise DataError(f"plan: expected at most {MAX_CELLS} cells, got {cells}; increase resolution (cell size)")
    column, row = np.floor((found.points[:, :2] - origin) / resolution).astype(np.int64).T
    number = row * columns + column  # (P,) cell of each point
    heights = found.points[:, 2]

    def any_of(chosen: Bool) -> Bool:
        return np.asarray(np.bincount(number[chosen], minlength=rows * columns) > 0).reshape(rows, columns)

    occupied = any_of((heights > CLEARANCE) & (heights < robot_height))
    floor = any_of((np.abs(heights) <= CLEARANCE) & found.level)
    wall = _walls(found, number, rows * columns).reshape(rows, columns)
    highest = _highest(found, number, rows * columns).reshape(rows, columns)
    drawn = Plan(resolution, origin, occupied, np.zeros_like(floor), floor, wall, highest)
    return replace(drawn, free=_free(room, drawn, robot_height))


def _free(room: UprightRoom, drawn: Plan, robot_height: float) -> Bool:
    """Return the mask (H, W) of the free cells."""
    free = drawn.floor & ~drawn.occupied
    rows, columns = np.nonzero(free)
    levels = np.arange(CLEARANCE, robot_height, LEVEL_STEP) + LEVEL_STEP / 2
    levels = np.minimum(levels, robot_height)
    xy = (np.stack([columns, rows], axis=1) + 0.5) * drawn.resolution + drawn.origin
    places = np.concatenate([np.repeat(xy, len(levels), axis=0), np.tile(levels, len(xy))[:, None]], axis=1)
    free[rows, columns] = looked_through(room, places).reshape(-1, len(levels)).all(axis=1)
    return free


def looked_through(room: UprightRoom, places: Float64) -> Bool:
    """Return the mask (P,) of the points (P, 3), m, that were observed as free space.

    The points are in the room frame.
    """
    through = np.zeros(len(places), np.bool_)
    rasterizer = Rasterizer(room.mesh.vertices, room.mesh.triangles)
    if not len(room.poses):
        return through
    for k in np.unique(np.linspace(0, len(room.poses) - 1, RENDERED_POSES).round().astype(int)):
        remaining = np.flatnonzero(~through)
        if not len(remaining):
            break
        depth = rasterizer.draw(ASSUMED_CAMERA, room.poses[k]).depth
        in_camera = transform(inverse(room.poses[k]), places[remaining])
        ahead = np.flatnonzero(in_camera[:, 2] > 0)
        u, v = np.rint(project(ASSUMED_CAMERA, in_camera[ahead])).T
        inside = (u >= 0) & (u < ASSUMED_CAMERA.width) & (v >= 0) & (v < ASSUMED_CAMERA.height)
        at = ahead[inside]
        surface = depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        through[remaining[at[(surface > in_camera[at, 2] + SLACK) & (surface < FARTHEST)]]] = True
    return through


def _walls(found: SurfacePoints, number: Int64, cells: int) -> Bool:
    """Return the mask (C,) of the cells with walls, given the cell (P,) of each point.

    A wall is part of a wall of the map, or another vertical surface at least WALL_SPAN high. Objects and furniture
    fronts are not walls.
    """
    chosen = found.upright & (found.owner == 0) & (found.structure != Structure.FRONT)
    step = np.floor(found.points[chosen, 2] / LEVEL_STEP).astype(np.int64)
    lowest, highest = step.min(initial=0), step.max(initial=0)
    filled = np.unique(number[chosen] * (highest - lowest + 1) + step - lowest) // (highest - lowest + 1)
    of_map = np.bincount(number[found.structure == Structure.WALL], minlength=cells) > 0
    return np.asarray((np.bincount(filled, minlength=cells) * LEVEL_STEP >= WALL_SPAN) | of_map)


def _highest(found: SurfacePoints, number: Int64, cells: int) -> Int32:
    """Return the id (C,) of the highest object in each cell, or 0 for a cell without objects.

    `number` (P,) is the cell of each point.
    """
    chosen = np.flatnonzero(found.owner > 0)
    rising = chosen[np.argsort(found.points[chosen, 2], kind="stable")]
    ids = np.zeros(cells, np.int32)
    ids[number[rising]] = found.owner[rising]  # repeated indices: the last value is stored
    return ids


OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # gray levels of map_saver
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # limits of (255 - level) / 255; UNKNOWN is just above FREE_THRESHOLD


def write_ros_map(directory: Path, found: Plan, room: UprightRoom) -> list[Path]:
    """Write map.pgm and map.yaml, in the room frame, for the map servers of ROS and ROS 2."""
    image, yaml = directory / "map.pgm", directory / "map.yaml"
    with atomic_write(image) as temporary:
        Image.fromarray(levels(found)).save(temporary)
    x, y = found.origin.tolist()
    lines = [
        *(f"# {comment}" for comment in origin_comments(room.origin)),
        f"image: {image.name}",
        "mode: trinary",
        f"resolution: {found.resolution:g}",
        f"origin: [{x:.6g}, {y:.6g}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    ]
    with atomic_write(yaml) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    return [image, yaml]


def levels(found: Plan) -> UInt8:
    """Return the gray levels (H, W) of map.pgm. The first row has the highest y."""
    gray = np.where(found.occupied, OCCUPIED, np.where(found.free, FREE, UNKNOWN)).astype(np.uint8)
    return np.ascontiguousarray(gray[::-1])
