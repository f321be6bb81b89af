"""Gravity direction and floor height.

If the sensor measures gravity, the mean over all frames is used. Otherwise, the up direction is estimated from the
surface. Most surfaces in a room are horizontal or vertical. In a box-shaped room, all three axes fit equally well. The
camera orientation and the area of upward-facing surfaces select the up axis.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from framework.data import UNIT_TOLERANCE, Float32, Float64, Int32
from framework.errors import DataError
from framework.interfaces import Gravity
from framework.mapping.storage.map_header import MapHeader

MAX_FRAMES = 1e9  # maximum number of frames of a map, and thus maximum length of a sum of unit vectors
AGREED = 0.95  # minimum length of the mean measured unit vector, e.g. if each vector is 18 degrees from the mean
DIGITS = 6  # number of decimals of each added vector; further digits depend on the memory layout
SAMPLED = 20_000  # approximate number of triangles sampled to refine the direction
VOTING = 5  # every VOTING-th sampled triangle votes for the candidate directions
DIRECTIONS = 3000  # number of candidate directions on a hemisphere, about 2.6 degrees apart
SPREAD = np.radians(4.0)  # standard deviation of the normals of horizontal and vertical surfaces, rad
NEAR = np.radians(10.0)  # maximum angle to horizontal or vertical of a triangle that refines the direction, rad
MAX_CAMERA_TILT = np.radians(50.0)  # maximum angle between up and the mean direction toward the upper image edge, rad
FACING_UP = 2.0  # weight of horizontal surfaces that face up; 1 = all axes of a box-shaped room get equal votes
MIN_FRACTION = 0.15  # minimum fraction of the surface area that is horizontal or vertical; a heap of objects has less
LEVEL = np.cos(np.radians(18.0))  # minimum dot product of up and the normal of a floor
STEP = 0.05  # bin size of heights, m
FLOOR_SAMPLED = 100_000  # approximate number of triangles sampled for the height of the floor
FLOOR_FRACTION = 0.05  # minimum area of the floor, as a fraction of the area of all horizontal surfaces
BELOW_FLOOR = 0.02  # maximum fraction of the surface area below the floor; caused by noise, windows and mirrors


log = logging.getLogger(__name__)


class GravityEstimator:
    """Estimator of the gravity direction from camera orientations, gravity measurements and the surface."""

    def __init__(self) -> None:
        self.camera_up: Float64 = np.zeros(3)  # (3,) sum of unit vectors toward the upper image edge, world frame
        self.sensed_up: Float64 = np.zeros(3)  # (3,) sum of measured unit vectors opposite to gravity, world frame
        self.sensed_frames = 0  # number of frames with a measured gravity direction
        self._warned = False

    def add_frame(self, T_world_camera: Float64, up_camera: Float64 | None = None) -> None:
        """Add the orientation and the measured gravity of one frame.

        Args:
            T_world_camera: The camera pose (4, 4).
            up_camera: The unit vector (3,) opposite to gravity in the camera frame, or None if the sensor does not
                measure gravity.
        """
        self.camera_up -= np.round(T_world_camera[:3, 1], DIGITS)
        if up_camera is not None:
            self.sensed_up += np.round(T_world_camera[:3, :3] @ up_camera, DIGITS)
            self.sensed_frames += 1

    def absorb(self, other: GravityEstimator, R_world_other: Float64) -> None:
        """Add the frames of another estimator, whose world frame is rotated by R_world_other (3, 3)."""
        self.camera_up += R_world_other @ other.camera_up
        self.sensed_up += R_world_other @ other.sensed_up
        self.sensed_frames += other.sensed_frames

    def saved(self) -> dict[str, Any]:
        """Return the entries for the header of the map file."""
        return {
            "camera_up": self.camera_up.tolist(),
            "sensed_up": self.sensed_up.tolist(),
            "sensed_frames": self.sensed_frames,
        }

    @classmethod
    def of(cls, header: MapHeader) -> GravityEstimator:
        """Return the estimator saved in the header of a map file.

        Raises:
            DataError: If the entries are invalid.
        """
        found = cls()
        found.camera_up = _vector(header, "camera_up")
        found.sensed_up = _vector(header, "sensed_up")
        found.sensed_frames = header.whole("sensed_frames")
        length = float(np.linalg.norm(found.sensed_up))
        if not length <= found.sensed_frames * (1 + UNIT_TOLERANCE):
            raise DataError(
                f"sensed_up: expected a length of at most {found.sensed_frames} (a sum of unit vectors), got "
                f"{length:.4g}"
            )
        return found

    def sensed(self) -> Float64 | None:
        """Return the measured up direction, a unit vector (3,) in the world frame.

        Return None if gravity was not measured or if the measurements disagree.
        """
        length = float(np.linalg.norm(self.sensed_up))
        if not self.sensed_frames:
            return None
        if length < AGREED * self.sensed_frames:
            if not self._warned:
                log.warning(
                    "sensor gravity: expected one direction in the world frame, got several; estimating gravity from "
                    "surfaces"
                )
            self._warned = True
            return None
        return self.sensed_up / length

    def estimate(self, vertices: Float32, triangles: Int32) -> Gravity:
        """Return the measured gravity direction, or an estimate from the surface if there is no usable measurement.

        The direction is unknown if too little of the surface is horizontal or vertical.

        Args:
            vertices: The vertices (V, 3) of the surface in the world frame, m.
            triangles: The triangles (F, 3) of the surface.
        """
        sensed = self.sensed()
        if sensed is not None:
            return Gravity(sensed, "sensor")
        up = self._up_of(vertices, triangles)
        return Gravity() if up is None else Gravity(up, "surfaces")

    def _up_of(self, vertices: Float32, triangles: Int32) -> Float64 | None:
        length = float(np.linalg.norm(self.camera_up))
        if length < 10.0**-DIGITS or not len(triangles):
            return None
        normals, areas, _ = faces(vertices, _sampled(triangles, SAMPLED))
        camera_up = self.camera_up / length
        directions = half_sphere(DIRECTIONS)
        directions *= np.where(directions @ camera_up < 0, -1.0, 1.0)[:, None]
        directions = directions[directions @ camera_up > np.cos(MAX_CAMERA_TILT)]
        votes = level_or_upright(normals[::VOTING], areas[::VOTING], directions, FACING_UP)
        best = directions[int(votes.argmax())]
        fraction = level_or_upright(normals[::VOTING], areas[::VOTING], best[None])
        return _refined(best, normals, areas) if fraction[0] >= MIN_FRACTION else None


def _vector(header: MapHeader, key: str) -> Float64:
    saved = header.items(key)
    numbers = [float(value) for value in saved if isinstance(value, int | float)]
    if len(numbers) != 3 or len(saved) != 3 or not (np.abs(numbers) < MAX_FRAMES).all():
        raise DataError(
            f"{key}: expected three numbers with absolute value below {MAX_FRAMES:g} (a sum of unit vectors), "
            f"got {saved!r:.60}"
        )
    return np.array(numbers)


def _sampled(triangles: Int32, count: int) -> Int32:
    """Return at least `count` evenly spaced triangles, or all if there are fewer."""
    return triangles[:: max(1, len(triangles) // count)]


def faces(vertices: Float32, triangles: Int32) -> tuple[Float64, Float64, Float64]:
    """Return the unit normals (N, 3), areas (N,), m^2, and centers (N, 3), m, of the triangles.

    Triangles with zero area are omitted.

    Args:
        vertices: The vertices (V, 3), m.
        triangles: The vertex indices (F, 3) of the triangles.
    """
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    real = lengths > 0
    return normals[real] / lengths[real, None], lengths[real] / 2, ((a + b + c) / 3)[real]


def half_sphere(count: int) -> Float64:
    """Return unit vectors (count, 3) evenly distributed over the hemisphere z > 0."""
    k = np.arange(count) + 0.5  # golden-angle spiral
    z = 1 - k / count
    turn, radius = np.pi * (1 + np.sqrt(5)) * k, np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def level_or_upright(normals: Float64, areas: Float64, directions: Float64, facing_up: float = 1.0) -> Float64:
    """Return the fraction (D,) of the surface that is horizontal or vertical for each candidate up direction.

    The contribution of a triangle decreases with its angle to horizontal or vertical.

    Args:
        normals: The unit normals (N, 3) of the triangles.
        areas: The areas (N,) of the triangles, m^2.
        directions: The candidate up directions (D, 3), unit vectors.
        facing_up: The weight of horizontal triangles that face up. If it is not 1, the result is not a fraction.
    """
    signed = normals.astype(np.float32) @ directions.T.astype(np.float32)
    cosines = np.abs(signed)
    # Gaussian of the angle a to horizontal or vertical: 1 - cos(a) = a^2 / 2, and cos(90 deg - a) = a, for small angles
    level = np.exp((cosines - 1) / np.float32(SPREAD**2)) * np.where(signed > 0, np.float32(facing_up), np.float32(1))
    votes = level + np.exp(-0.5 * (cosines / np.float32(SPREAD)) ** 2)
    return np.asarray(areas @ votes.astype(np.float64) / areas.sum())


def _refined(up: Float64, normals: Float64, areas: Float64) -> Float64:
    """Refine the up direction by an iterative least-squares fit to the nearly horizontal and vertical triangles."""
    for _ in range(5):
        cosines = normals @ up
        level, upright = np.abs(cosines) > np.cos(NEAR), np.abs(cosines) < np.sin(NEAR)
        weights = areas * (upright.astype(np.float64) - level)
        _, vectors = np.linalg.eigh((normals * weights[:, None]).T @ normals)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return np.asarray(up)


def floor_height(vertices: Float32, triangles: Int32, up: Float64) -> float | None:
    """Return the height of the floor above the world origin, m, or None if the floor was not seen.

    The floor is the lowest large horizontal surface. Almost no surface may be below it.

    Args:
        vertices: The vertices (V, 3) in the world frame, m.
        triangles: The triangles (F, 3).
        up: The up direction (3,), a unit vector in the world frame.
    """
    normals, areas, centers = faces(vertices, _sampled(triangles, FLOOR_SAMPLED))
    heights = centers @ up
    level = normals @ up > LEVEL
    if not level.any():
        return None
    edges = np.arange(heights[level].min(), heights[level].max() + 2 * STEP, STEP)
    area, _ = np.histogram(heights[level], edges, weights=areas[level])
    wide = area + np.append(area[1:], 0)  # a floor may be at the edge between two bins
    lowest = int(np.argmax(wide >= FLOOR_FRACTION * area.sum()))
    within = level & (heights >= edges[lowest]) & (heights < edges[lowest] + 2 * STEP)
    height = float(np.average(heights[within], weights=areas[within]))
    below = areas[heights < height - 2 * STEP].sum()
    return height if below <= BELOW_FLOOR * areas.sum() else None
