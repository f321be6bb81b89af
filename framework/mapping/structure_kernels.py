"""Kernels for the planes of a room."""

from __future__ import annotations

import numpy as np
from numba import prange

from framework.compilation.kernel_cache import njit

OBLIQUE = np.float32(0.1)  # minimum dot product of the normals of a plane and of a vertex next to an edge of the plane
ALIGNED = np.float32(np.cos(np.radians(35.0)))  # minimum dot product of the normals of a plane and of its vertices


@njit(cache=True, nogil=True)
def sum_normals(vertices, triangles, normals):
    """Add the normal of each triangle, whose length is twice the area, to the normals of its vertices.

    Args:
        vertices: The vertices (V, 3), m.
        triangles: The vertex indices (F, 3) of the triangles.
        normals: The output (V, 3), m^2, initially 0.
    """
    for f in range(len(triangles)):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for v in (a, b, c):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z


@njit(cache=True, nogil=True, parallel=True)
def label_plane_vertices(vertices, normals, planes, along, columns, width, reach, plane_of_vertex):
    """Find the nearest plane of each vertex.

    Args:
        vertices: The vertices (V, 3), m.
        normals: The normals (V, 3) of the vertices, of any length.
        planes: The planes (K, 4): unit normal n and offset d, m; a point p is on the plane if n . p = d.
        along: The axis (K, 4) of the columns of each plane: unit vector a and start s, m.
        columns: A Boolean array (K, C), True for the columns (a . p - s) / width that count.
        width: The width of a column, m.
        reach: The maximum distance of a vertex from its plane, m. Half of it for vertices with oblique normals.
        plane_of_vertex: The output (V,), 1 + the index of the plane, 0 = no plane.
    """
    for v in prange(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        nx, ny, nz = normals[v, 0], normals[v, 1], normals[v, 2]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        nearest, found = reach, 0
        for k in range(len(planes)):
            distance = abs(planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z - planes[k, 3])
            if distance > nearest:
                continue
            cosine = planes[k, 0] * nx + planes[k, 1] * ny + planes[k, 2] * nz
            if cosine >= ALIGNED * length or (distance <= reach / 2 and cosine >= OBLIQUE * length):
                column = int((along[k, 0] * x + along[k, 1] * y + along[k, 2] * z - along[k, 3]) / width)
                if columns[k, min(max(column, 0), columns.shape[1] - 1)]:
                    nearest, found = distance, k + 1
        plane_of_vertex[v] = found


@njit(cache=True, nogil=True, parallel=True)
def find_near_samples(points, normals, planes, reach, cosine, near):
    """Find the samples that are near a plane and face the same side.

    Args:
        points: The samples (N, 3), m.
        normals: The unit normals (N, 3) of the samples.
        planes: The planes (K, 4), as in `label_plane_vertices`.
        reach: The maximum distance of a sample from a plane, m.
        cosine: The minimum dot product of the normals of a sample and a plane.
        near: The output (K, N), 1 for such samples, otherwise 0.
    """
    for k in prange(len(planes)):
        a, b, c, d = planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3]
        for i in range(len(points)):
            distance = a * points[i, 0] + b * points[i, 1] + c * points[i, 2] - d
            aligned = a * normals[i, 0] + b * normals[i, 1] + c * normals[i, 2]
            near[k, i] = 1 if abs(distance) < reach and aligned > cosine else 0
