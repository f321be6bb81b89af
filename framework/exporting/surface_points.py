"""A surface as points that are evenly spread over it, whatever the size of its triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float32, Float64, Int32, Int64
from framework.errors import DataError
from framework.exporting.upright_room import UprightRoom

MOST_POINTS = 2**24  # of a room; one of 100 m^2 of surface has 4 million, a voxel of 1 cm giving 2 triangles
LEVEL = float(np.cos(np.radians(30.0)))  # z of a normal, from which on a surface is one that things may stand on
UPRIGHT = float(np.sin(np.radians(20.0)))  # |z| of a normal, up to which it is that of a wall


@dataclass(frozen=True)
class SurfacePoints:
    """P points on a room's surface."""

    points: Float32  # (P, 3) m, room
    normal_z: Float32  # (P,) of the unit normal
    owner: Int32  # (P,) the id of the object that all of the triangle is of, 0 = of none

    @property
    def level(self) -> Bool:
        """(P,) whether it faces up."""
        return np.asarray(self.normal_z > LEVEL)

    @property
    def upright(self) -> Bool:
        """(P,) whether it may be of a wall."""
        return np.asarray(np.abs(self.normal_z) < UPRIGHT)


def surface_points(room: UprightRoom, spacing: float) -> SurfacePoints:
    """The middles of a room's triangles, each cut into pieces whose sides are at most `spacing` m.

    Raises DataError where that would be more than MOST_POINTS.
    """
    vertices, triangles = room.mesh.vertices, room.mesh.triangles
    corners = vertices[triangles]  # (F, 3, 3)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0)
    cuts = np.maximum(np.ceil(longest / spacing), 1)
    if float((cuts**2).sum()) > MOST_POINTS:
        raise DataError(
            f"the surface is too large for points {spacing:g} m apart: raise the resolution, or map with larger voxels"
        )
    normals = room.surface.face_normals
    normal_z = (normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-20)).astype(np.float32)
    owner = np.zeros(len(vertices), np.int32)
    for one in room.objects:
        owner[one.vertices] = one.id
    ids = owner[triangles]
    of_triangle = np.where((ids == ids[:, :1]).all(axis=1), ids[:, 0], 0).astype(np.int32)
    points, chosen = [], []
    for n in np.unique(cuts).astype(np.int64).tolist():
        these = np.flatnonzero(cuts == n)
        weights = middles(n)
        points.append(np.einsum("kc,fcx->fkx", weights, corners[these]).reshape(-1, 3))
        chosen.append(np.repeat(these, len(weights)))
    which: Int64 = np.concatenate(chosen) if chosen else np.zeros(0, np.int64)
    return SurfacePoints(
        np.concatenate(points).astype(np.float32) if points else np.zeros((0, 3), np.float32),
        normal_z[which],
        of_triangle[which],
    )


def middles(n: int) -> Float64:
    """(n^2, 3) barycentric weights of the middles of the equal pieces that a triangle is cut into, n along a side."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    up, down = i + j < n, i + j < n - 1
    first = np.stack([i[up] + 1 / 3, j[up] + 1 / 3], axis=1)
    second = np.stack([i[down] + 2 / 3, j[down] + 2 / 3], axis=1)
    ij = np.concatenate([first, second]) / n
    return np.column_stack([1 - ij.sum(axis=1), ij])
