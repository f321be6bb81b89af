"""Floor, walls, ceiling and large furniture fronts, from the planes of a map.

Planes are proposed by small parts of the surface and selected greedily by their area. A plane is structure if it is at
the border of the room: the lowest large plane that faces up is the floor, the highest one that faces down is the
ceiling, and walls are vertical planes that reach high above the floor, with little surface behind them. The result
depends on the surface alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from framework.data import Bool, Float32, Float64, Int32, Structure, UInt8
from framework.mapping.structure_kernels import find_near_samples, label_plane_vertices, sum_normals
from framework.mapping.voxels.meshing import UnlabeledMesh

SAMPLED = 20_000  # approximate number of vertices that are used to find planes
PART = 0.5  # m, minimum side of the parts of the surface that propose planes
SAMPLES = 12  # minimum average number of samples of a part with a plane
SIMILAR = np.array([0.1, 0.1, 0.1, 0.05])  # difference of normals, and of offsets in m, of equal proposals
MIN_SAMPLES = 6  # minimum number of samples of a part
SEARCH = 0.06  # m, maximum distance of samples from a proposed plane
REACH = 0.03  # m, maximum distance of vertices from their plane
PARALLEL = np.cos(np.radians(20.0))  # minimum dot product of the normals of a plane and of its samples
LEVEL = np.cos(np.radians(10.0))  # minimum dot product of up and the normal of a horizontal plane
UPRIGHT = np.sin(np.radians(8.0))  # maximum dot product of up and the normal of a vertical plane
MIN_AREA = 0.6  # m^2, minimum visible area of a plane
MIN_CEILING_AREA = 0.2  # m^2, minimum visible area of a plane that faces down; cameras see little of ceilings
MAX_PLANES = 60  # maximum number of planes
BEYOND = 0.02  # maximum fraction of the surface area below the floor, above the ceiling
CLEARANCE = 0.1  # m, minimum distance of surface below the floor or above the ceiling
MIN_STORY = 4.0  # m^2, minimum visible area of a floor above stairs or another lower story
LOWER_STORY = 0.2  # maximum visible area of lower floors, as a fraction of the area of a floor
MIN_WALL_TOP = 1.7  # m, minimum height of the upper end of a wall above the floor
MIN_WALL_HEIGHT = 0.6  # m, minimum height of the visible part of a wall
TOP = 0.25  # m, maximum distance of the upper end of a wall from the upper end of the map, where the map is low
COLUMN = 0.25  # m, width of the columns of a wall, each of which reaches high
FRONT_DEPTH = (0.1, 1.0)  # m, distance of furniture fronts from the wall behind
MIN_FLAT = 0.5  # minimum fraction of the vertices of a flat instance that are on floor, walls and ceiling
MIN_OWN = 0.5  # minimum fraction of the vertices on a plane that are on one instance, if the plane is a side of it
MIN_CEILING = 1.8  # m, minimum height of a ceiling above the floor


@dataclass(frozen=True)
class RoomPlanes:
    """The K planes of a map that are structure."""

    planes: Float64  # (K, 4) unit normal n toward the observed side and offset d, m; p is on the plane if n . p = d
    kinds: UInt8  # (K,) `Structure`
    along: Float64  # (K, 4) horizontal unit vector a in the plane and start s, m; column of p: (a . p - s) / COLUMN
    columns: Bool  # (K, C) True for the columns of the plane that are structure; points beyond an end are in its column


@dataclass(frozen=True)
class SurfaceStructure:
    """The structure of the V vertices of a surface."""

    planes: Int32  # (V,) plane of each vertex, 0 = none
    kinds: UInt8  # (K + 1,) `Structure` of each plane

    @property
    def of_vertices(self) -> UInt8:
        """The `Structure` (V,) of each vertex."""
        return self.kinds[self.planes]


class VertexStructure:
    """The structure of the vertices of a surface, which is computed again only for another surface or up direction."""

    def __init__(self) -> None:
        self._surface: UnlabeledMesh | None = None
        self._up: bytes | None = None
        self._structure = SurfaceStructure(np.zeros(0, np.int32), np.zeros(1, np.uint8))

    def __reduce__(self) -> tuple[type[VertexStructure], tuple[()]]:
        return VertexStructure, ()

    def of(self, surface: UnlabeledMesh, up: Float64 | None) -> SurfaceStructure:
        """Return the structure of the vertices, which is NONE for all vertices if `up` is None.

        Args:
            surface: The surface.
            up: The up direction (3,), a unit vector in the world frame; None = unknown.
        """
        up_bytes = None if up is None else up.tobytes()
        if surface is not self._surface or up_bytes != self._up:
            self._surface, self._up = surface, up_bytes
            self._structure = SurfaceStructure(np.zeros(len(surface.vertices), np.int32), np.zeros(1, np.uint8))
            if up is not None:
                self._structure = structure_of(surface.vertices, surface.triangles, up)
        return self._structure


def structure_of(vertices: Float32, triangles: Int32, up: Float64) -> SurfaceStructure:
    """Return the structure of the vertices of a surface.

    Args:
        vertices: The vertices (V, 3) of the surface in the world frame, m.
        triangles: The triangles (F, 3) of the surface, whose normals point to the observed side.
        up: The up direction (3,), a unit vector in the world frame.
    """
    normals = np.zeros_like(vertices)
    sum_normals(vertices, triangles, normals)
    with threadpool_limits(1, "blas"):  # the last digits depend on the number of threads
        found = room_planes(SurfaceSamples.of(vertices, normals), up)
    plane_of_vertex = np.zeros(len(vertices), np.int32)
    label_plane_vertices(
        vertices, normals, found.planes.astype(np.float32), found.along.astype(np.float32), found.columns,
        np.float32(COLUMN), np.float32(REACH), plane_of_vertex,
    )  # fmt: skip
    return SurfaceStructure(plane_of_vertex, np.append(np.uint8(Structure.NONE), found.kinds))


def separate_instances(instance_ids: Int32, structure: SurfaceStructure, flat: Bool) -> Int32:
    """Return the instance (V,) of each vertex without the vertices on floor, walls and ceiling.

    Flat instances, such as pictures, keep these vertices if at least half of their vertices are on them. They also keep
    the vertices on a plane if at least half of these are on the instance, for example on the side of a refrigerator.

    Args:
        instance_ids: The instance (V,) of each vertex, 0 = none.
        structure: The structure of the vertices.
        flat: A Boolean array, True for the ids of likely instances that can be in the plane of a floor or a wall.
    """
    on_structure = is_building(structure.of_vertices)
    shape = len(flat), len(structure.kinds)
    pairs = instance_ids[on_structure] * shape[1] + structure.planes[on_structure]
    counts = np.bincount(pairs, minlength=shape[0] * shape[1]).reshape(shape)  # by instance and plane
    sizes = np.bincount(instance_ids, minlength=len(flat))
    is_flat = counts.sum(axis=1) >= MIN_FLAT * sizes
    keeps = flat[:, None] & (is_flat[:, None] | (counts >= MIN_OWN * counts.sum(axis=0)))
    return np.where(on_structure & ~keeps[instance_ids, structure.planes], np.int32(0), instance_ids)


def is_building(structure: UInt8) -> Bool:
    """Return a mask (V,) of the vertices on floor, walls and ceiling, given their `Structure` (V,)."""
    return np.asarray((structure != Structure.NONE) & (structure != Structure.FRONT))


@dataclass(frozen=True)
class SurfaceSamples:
    """N vertices of a surface."""

    points: Float64  # (N, 3) m
    normals: Float64  # (N, 3) unit vectors
    areas: Float64  # (N,) m^2

    @classmethod
    def of(cls, vertices: Float32, normals: Float32) -> SurfaceSamples:
        """Return evenly selected vertices. The length of a normal is six times the area of its vertex."""
        step = max(1, len(vertices) // SAMPLED)
        points, chosen = vertices[::step].astype(np.float64), normals[::step].astype(np.float64)
        lengths = np.linalg.norm(chosen, axis=1)
        real = lengths > 0
        return cls(points[real], chosen[real] / lengths[real, None], lengths[real] * step / 6)


def room_planes(samples: SurfaceSamples, up: Float64) -> RoomPlanes:
    """Return the planes of a surface that are structure.

    Args:
        samples: Samples of the surface.
        up: The up direction (3,), a unit vector.
    """
    planes, inliers = find_planes(samples, up)
    kinds, enough = classify(planes, inliers, samples, up)
    chosen = np.flatnonzero(kinds != Structure.NONE)
    along, rows = np.zeros((len(chosen), 4)), [np.ones(1, np.bool_)] * len(chosen)
    for row, k in enumerate(chosen):
        if kinds[k] in (Structure.WALL, Structure.FRONT):
            along[row], rows[row] = _columns(planes[k], samples.points[inliers[k]], up, enough)
    columns = np.zeros((len(chosen), max(map(len, rows), default=1)), np.bool_)
    for row, values in enumerate(rows):
        columns[row, : len(values)] = values
    return RoomPlanes(planes[chosen], kinds[chosen], along, columns)


def _columns(plane: Float64, points: Float64, up: Float64, enough: float) -> tuple[Float64, Bool]:
    """Return the axis (4,) of the columns of a wall, and the columns whose upper end is at least at `enough`, m.

    The first and the last column are empty. Columns next to high columns are included.
    """
    axis = np.cross(up, plane[:3])
    axis /= np.linalg.norm(axis)
    positions = points @ axis
    start = positions.min() - 2 * COLUMN
    index = ((positions - start) / COLUMN).astype(np.int64)
    tops = np.full(index.max() + 3, -np.inf)
    np.maximum.at(tops, index, points @ up)
    high = tops >= enough
    return np.append(axis, start), high | np.roll(high, 1) | np.roll(high, -1)


def find_planes(samples: SurfaceSamples, up: Float64) -> tuple[Float64, Bool]:
    """Return the large horizontal and vertical planes (K, 4) of a surface, and their samples (K, N).

    Args:
        samples: Samples of the surface.
        up: The up direction (3,), a unit vector.
    """
    proposals = _proposals(samples, up)
    areas = samples.areas.astype(np.float32)
    votes = np.zeros((len(proposals), len(samples.points)), np.float32)
    find_near_samples(samples.points, samples.normals, proposals, SEARCH, PARALLEL, votes)
    free = np.ones(len(samples.points), np.bool_)
    minimum = np.where(proposals[:, :3] @ up < -LEVEL, MIN_CEILING_AREA, MIN_AREA)
    planes: list[Float64] = []
    inliers: list[Bool] = []
    while len(proposals) and len(planes) < MAX_PLANES:
        visible = votes @ (areas * free) / minimum
        best = int(visible.argmax())
        if visible[best] < 1:
            break
        plane, own = _refined(proposals[best], samples, free)
        if not own.any():
            votes[best] = 0
            continue
        free &= ~(own | (votes[best] > 0))
        if samples.areas[own].sum() >= minimum[best] and _is_level_or_upright(float(plane[:3] @ up)):
            planes.append(plane)
            inliers.append(own)
    count = len(planes)
    return np.array(planes).reshape(count, 4), np.array(inliers, np.bool_).reshape(count, len(samples.points))


def _is_level_or_upright(cosine: float) -> bool:
    return bool(abs(cosine) > LEVEL or abs(cosine) < UPRIGHT)


def _proposals(samples: SurfaceSamples, up: Float64) -> Float64:
    """Return the mean plane (P, 4) of the samples of each part of the surface that are about horizontal or vertical."""
    cosines = samples.normals @ up
    chosen = np.flatnonzero((np.abs(cosines) > PARALLEL) | (np.abs(cosines) < np.sqrt(1 - PARALLEL**2)))
    normals, points = samples.normals[chosen], samples.points[chosen]
    side = max(PART, float(np.sqrt(SAMPLES * samples.areas.mean()))) if len(samples.areas) else PART
    keys = np.column_stack([np.floor(points / side), np.round(normals)]).astype(np.int64)
    _, group, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), 6))
    np.add.at(sums, group.ravel(), np.column_stack([normals, points]))
    sums = sums[counts >= MIN_SAMPLES] / counts[counts >= MIN_SAMPLES, None]
    sums[:, :3] /= np.maximum(np.linalg.norm(sums[:, :3], axis=1, keepdims=True), 1e-9)
    proposals = np.column_stack([sums[:, :3], (sums[:, :3] * sums[:, 3:]).sum(axis=1)])
    _, first = np.unique(np.round(proposals / SIMILAR), axis=0, return_index=True)
    return proposals[np.sort(first)]


def _refined(plane: Float64, samples: SurfaceSamples, free: Bool) -> tuple[Float64, Bool]:
    """Fit a plane (4,) to the free samples near it, and return it with a mask (N,) of its samples."""
    for reach in (SEARCH, SEARCH, REACH, REACH):
        own = free & (np.abs(samples.points @ plane[:3] - plane[3]) < reach)
        own &= samples.normals @ plane[:3] > PARALLEL
        if own.sum() < 3:
            return plane, np.zeros_like(own)
        points, areas = samples.points[own], samples.areas[own]
        center = np.average(points, axis=0, weights=areas)
        offsets = points - center
        _, vectors = np.linalg.eigh((offsets * areas[:, None]).T @ offsets)
        normal = vectors[:, 0] * (1 if vectors[:, 0] @ plane[:3] > 0 else -1)
        plane = np.append(normal, normal @ center)
    return plane, own


def classify(planes: Float64, inliers: Bool, samples: SurfaceSamples, up: Float64) -> tuple[UInt8, float]:
    """Return the `Structure` (K,) of planes, and the minimum height of the upper end of walls in the world frame, m.

    Args:
        planes: The planes (K, 4).
        inliers: The samples (K, N) of each plane.
        samples: Samples of the surface.
        up: The up direction (3,), a unit vector.
    """
    kinds = np.full(len(planes), Structure.NONE, np.uint8)
    heights, total = samples.points @ up, samples.areas.sum()
    middle = np.array([np.average(heights[own], weights=samples.areas[own]) for own in inliers])
    cosines = planes[:, :3] @ up
    faces_up = samples.normals @ up > LEVEL
    for k in np.flatnonzero(cosines > LEVEL):
        below = heights < middle[k] - CLEARANCE
        is_lowest = samples.areas[below].sum() <= BEYOND * total
        area = samples.areas[inliers[k]].sum()
        if is_lowest or (area >= MIN_STORY and samples.areas[below & faces_up].sum() <= LOWER_STORY * area):
            kinds[k] = Structure.FLOOR
    floors = np.flatnonzero(kinds == Structure.FLOOR)
    floor = middle[max(floors, key=lambda k: samples.areas[inliers[k]].sum())] if len(floors) else None
    for k in np.flatnonzero(cosines < -LEVEL):
        above = samples.areas[heights > middle[k] + CLEARANCE].sum()
        if above <= BEYOND * total and (floor is None or middle[k] > floor + MIN_CEILING):
            kinds[k] = Structure.CEILING
    low, high = np.quantile(heights, (0.005, 0.995)) if len(heights) else (0.0, 0.0)
    enough = float(min((low if floor is None else floor) + MIN_WALL_TOP, high - TOP))
    for k in np.flatnonzero(np.abs(cosines) < UPRIGHT):
        bottom, top = np.quantile(heights[inliers[k]], (0.03, 0.97))
        if top >= enough and top - bottom >= MIN_WALL_HEIGHT:
            kinds[k] = Structure.WALL
    walls = np.flatnonzero(kinds == Structure.WALL)
    for k in walls:
        if any(_is_front(planes[k], inliers[k], planes[j], inliers[j], samples, up) for j in walls if j != k):
            kinds[k] = Structure.FRONT
    return kinds, enough


def _is_front(front: Float64, own: Bool, wall: Float64, others: Bool, samples: SurfaceSamples, up: Float64) -> bool:
    """Return True if a vertical plane is in front of a wall that extends to both of its sides."""
    if front[:3] @ wall[:3] < PARALLEL:
        return False
    distance = float(np.average(samples.points[own] @ wall[:3] - wall[3], weights=samples.areas[own]))
    if not FRONT_DEPTH[0] <= distance <= FRONT_DEPTH[1]:
        return False
    along = np.cross(up, wall[:3])
    left, right = np.quantile(samples.points[own] @ along, (0.03, 0.97))
    wall_left, wall_right = np.quantile(samples.points[others] @ along, (0.03, 0.97))
    return bool(wall_left < left and right < wall_right)
