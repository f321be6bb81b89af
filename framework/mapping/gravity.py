"""Which way is up, by sensors or else by the surface of a room and how the camera was held; how high the floor is.

What sensors told is up, whatever the surface is: the mean over all frames, in which an accelerometer's changes of
velocity are none. Simulated from the true poses, with noise of 0.5 to 3 degrees in each frame, it is 0.05 to 0.8
degrees off in the videos below, of 40 to 123 frames; with noise and a constant bias of 1 degree each 0.1 to 0.9; with
one of 2 degrees up to 1.6. Surfaces do not refine it: in made-up rooms they would make good a bias of half a degree
and more, in real ones nobody can tell, where floor and ceiling themselves are 1 degree off the world's axis (flat),
and over a slanted table they would do harm.

Rooms have floors, tables and walls: up is the direction that most of the surface is perpendicular to or along, near to
where the images' upper edges pointed on average, for these tell walls from floors, as does what faces up. Angles to the
truth: 0 to 1.0 degrees in a flat, a ScanNet room, five windows of TUM's desk and three made-up rooms; kitchen and study
room look right, unmeasured. Heights of the floor: 0.03 m off at most, where the truth has it at 0 and it is told.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from framework.data import UNIT_TOLERANCE, Float32, Float64, Int32
from framework.errors import DataError
from framework.mapping.storage.map_header import MapHeader

MOST_FRAMES = 1e9  # of a map
AGREED = 0.95  # length of the mean of sensors' unit vectors, at least: so they are 18 degrees off it, or less
DIGITS = 6  # of what a frame adds: the last ones of float64 depend on how arrays lie in memory
SAMPLED = 20_000  # triangles that refine a direction; each VOTING-th of them votes for it
VOTING = 5
DIRECTIONS = 3000  # on half a sphere, that are tried: 2.6 degrees apart
SPREAD = np.radians(4.0)  # standard deviation of a surface's normal from what it is meant to be
NEAR = np.radians(10.0)  # surfaces that refine the direction found
HELD_WITHIN = np.radians(50.0)  # of up, that images' upper edges point on average
FACING_UP = 2.0  # votes of what faces up; in a boxy room all three axes have the same share; 1.5 to 4 do as well
LEAST_SHARE = 0.15  # of the surface must be level or upright; of a heap of things nothing is
LEVEL = np.cos(np.radians(18.0))  # a normal's dot product with up, of what may be floor
STEP = 0.05  # m, of heights
FLOOR_SHARE = 0.05  # of all level surface, that lies within a step of the floor's height, at least
BELOW_FLOOR = 0.02  # of all surface, that may lie lower: noise, and what windows and mirrors show


log = logging.getLogger(__name__)


class Gravity:
    """How the camera has been held so far, and what sensors told."""

    def __init__(self) -> None:
        self.camera_up: Float64 = np.zeros(3)  # (3,) sum of the unit vectors up in the images
        self.sensed_up: Float64 = np.zeros(3)  # (3,) sum of the unit vectors against gravity, in the world
        self.sensed_frames = 0  # of which a sensor told
        self._warned = False

    def held(self, T_world_camera: Float64, up_camera: Float64 | None = None) -> None:
        """Counts one frame, in whose camera a sensor told that up is the unit vector `up_camera` (3,); None = none."""
        self.camera_up -= np.round(T_world_camera[:3, 1], DIGITS)
        if up_camera is not None:
            self.sensed_up += np.round(T_world_camera[:3, :3] @ up_camera, DIGITS)
            self.sensed_frames += 1

    def saved(self) -> dict[str, Any]:
        """What a map's header has of it."""
        return {
            "camera_up": self.camera_up.tolist(),
            "sensed_up": self.sensed_up.tolist(),
            "sensed_frames": self.sensed_frames,
        }

    @classmethod
    def of(cls, header: MapHeader) -> Gravity:
        """The one that was saved in a map's header. Raises DataError where it is none."""
        gravity = cls()
        gravity.camera_up = _vector(header, "camera_up")
        gravity.sensed_up = _vector(header, "sensed_up")
        gravity.sensed_frames = header.whole("sensed_frames")
        length = float(np.linalg.norm(gravity.sensed_up))
        if not length <= gravity.sensed_frames * (1 + UNIT_TOLERANCE):
            raise DataError(f"sensed_up has the length {length:.4g}, of {gravity.sensed_frames} unit vectors")
        return gravity

    def sensed(self) -> Float64 | None:
        """The unit vector (3,) up in the world by sensors; None where none told, or frames contradict each other."""
        length = float(np.linalg.norm(self.sensed_up))
        if not self.sensed_frames:
            return None
        if length < AGREED * self.sensed_frames:
            if not self._warned:
                log.warning("up, as a sensor told it, is not one direction in the world: floors and walls are asked")
            self._warned = True
            return None
        return self.sensed_up / length

    def up(self, vertices: Float32, triangles: Int32) -> Float64 | None:
        """The unit vector (3,) up in the world: what sensors told, else by a surface.

        None where there is no surface, or nothing in it is level.
        """
        sensed = self.sensed()
        return sensed if sensed is not None else self._up_of(vertices, triangles)

    def _up_of(self, vertices: Float32, triangles: Int32) -> Float64 | None:
        """By a surface."""
        length = float(np.linalg.norm(self.camera_up))
        if length < 10.0**-DIGITS or not len(triangles):
            return None
        chosen = triangles[:: max(1, len(triangles) // SAMPLED)]
        normals, areas, _ = faces(vertices, chosen)
        camera_up = self.camera_up / length
        directions = half_sphere(DIRECTIONS)
        directions *= np.where(directions @ camera_up < 0, -1.0, 1.0)[:, None]
        directions = directions[directions @ camera_up > np.cos(HELD_WITHIN)]
        votes = level_or_upright(normals[::VOTING], areas[::VOTING], directions, FACING_UP)
        up = _refined(directions[int(votes.argmax())], normals, areas)
        share = level_or_upright(normals[::VOTING], areas[::VOTING], directions[[int(votes.argmax())]])
        return up if share[0] >= LEAST_SHARE else None


def _vector(header: MapHeader, key: str) -> Float64:
    saved = header.items(key)
    numbers = [float(value) for value in saved if isinstance(value, int | float)]
    if len(numbers) != 3 or len(saved) != 3 or not (np.abs(numbers) < MOST_FRAMES).all():
        raise DataError(f"{key} must be three numbers, sums of unit vectors, found {saved!r:.60}")
    return np.array(numbers)


def faces(vertices: Float32, triangles: Int32) -> tuple[Float64, Float64, Float64]:
    """The unit normals (T, 3), areas (T,) m^2 and centres (T, 3) m of triangles, without those that have no area."""
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    real = lengths > 0
    return normals[real] / lengths[real, None], lengths[real] / 2, ((a + b + c) / 3)[real]


def half_sphere(count: int) -> Float64:
    """(count, 3) unit vectors, evenly spread over half a sphere: a spiral by the golden angle."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    turn, radius = np.pi * (1 + np.sqrt(5)) * k, np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def level_or_upright(normals: Float64, areas: Float64, directions: Float64, facing_up: float = 1.0) -> Float64:
    """(D,) the share of the surface that is level or upright if a direction is up, times `facing_up` what faces it."""
    signed = normals.astype(np.float32) @ directions.T.astype(np.float32)
    cosines = np.abs(signed)
    # of small angles: 1 - cos(a) = a^2 / 2, and for what is upright cos(90 deg - a) = a
    level = np.exp((cosines - 1) / np.float32(SPREAD**2)) * np.where(signed > 0, np.float32(facing_up), np.float32(1))
    votes = level + np.exp(-0.5 * (cosines / np.float32(SPREAD)) ** 2)
    return np.asarray(areas @ votes.astype(np.float64) / areas.sum())


def _refined(up: Float64, normals: Float64, areas: Float64) -> Float64:
    """The direction that is most along the normals of what is nearly level, and most across those of walls."""
    for _ in range(5):
        cosines = normals @ up
        level, upright = np.abs(cosines) > np.cos(NEAR), np.abs(cosines) < np.sin(NEAR)
        weights = areas * (upright.astype(np.float64) - level)
        _, vectors = np.linalg.eigh((normals * weights[:, None]).T @ normals)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return np.asarray(up)


def floor_height(vertices: Float32, triangles: Int32, up: Float64) -> float | None:
    """m along `up` of the floor: the lowest level surface of some size, with next to nothing below. None = not seen."""
    normals, areas, centers = faces(vertices, triangles)
    heights = centers @ up
    level = normals @ up > LEVEL
    if not level.any():
        return None
    edges = np.arange(heights[level].min(), heights[level].max() + 2 * STEP, STEP)
    area, _ = np.histogram(heights[level], edges, weights=areas[level])
    wide = area + np.append(area[1:], 0)  # a floor may lie on the edge between two steps
    lowest = int(np.argmax(wide >= FLOOR_SHARE * area.sum()))
    within = level & (heights >= edges[lowest]) & (heights < edges[lowest] + 2 * STEP)
    height = float(np.average(heights[within], weights=areas[within]))
    below = areas[heights < height - 2 * STEP].sum()
    return height if below <= BELOW_FLOOR * areas.sum() else None
