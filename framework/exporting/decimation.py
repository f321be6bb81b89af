"""Cutting, joining and decimation of meshes.

Decimation keeps the texture of flat surfaces and is fast for huge maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from framework.data import Bool, Float32, Float64, InstanceMesh, Int32, Int64

OBJECTS_SHARE = 0.5  # fraction of the triangles for objects
FEWEST = 4  # triangles of a closed surface
QUADRIC_STEP = 2.5  # quadric decimation is quadratic in the ratio of triangles: larger meshes are clustered first
LEFT_TO_QUADRIC = 1.8  # ratio of triangles after clustering and after quadric decimation
FEW = 20_000  # triangles, below which a mesh is not clustered: cells would be as large as objects
RELIEF = 0.03  # m between white and black
BRIGHTNESS = np.array([0.299, 0.587, 0.114])  # of red, green and blue, ITU-R BT.601
COARSER = 1.3  # ratio of two cell sizes that are tried


def decimated(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Return the mesh with at most so many triangles (at least FEWEST).

    Method: Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997, of Open3D, after
    vertex clustering of meshes that are much larger.
    """
    most = max(triangles, FEWEST)
    wanted = max(most, FEW)
    if len(mesh.triangles) > QUADRIC_STEP * wanted:
        cell, model = _cell(mesh, int(LEFT_TO_QUADRIC * wanted)), _open3d(mesh)
        model = model.simplify_vertex_clustering(cell)
        while len(model.triangles) > QUADRIC_STEP * wanted:
            cell *= COARSER
            model = model.simplify_vertex_clustering(cell)
        mesh = _relabeled(model, mesh)
    return _collapsed(mesh, most) if len(mesh.triangles) > most else mesh


def with_finer_objects(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Decimate a mesh, its objects less than the rest.

    The two are decimated separately, which keeps their border; vertices outside objects lose their labels.
    """
    owners = triangle_labels(mesh.triangles, mesh.instance_ids)
    of_object = owners > 0
    counts = int(of_object.sum()), int((~of_object).sum())
    objects = min(counts[0], max(int(OBJECTS_SHARE * triangles), triangles - counts[1]))
    ids = mesh.instance_ids.copy()
    corners = mesh.triangles[of_object]
    bare = ids[corners] == 0  # on the border; a coarse triangle may have only such corners
    ids[corners[bare]] = np.broadcast_to(owners[of_object, None], corners.shape)[bare]
    found = submesh(replace(mesh, instance_ids=ids), corners_of(mesh, of_object), of_object)
    around = submesh(replace(mesh, instance_ids=np.zeros_like(ids)), corners_of(mesh, ~of_object), ~of_object)
    return joined([decimated(found, objects), decimated(around, triangles - objects)])


def clustered(mesh: InstanceMesh, most_bytes: int, bytes_of_vertex: int, bytes_of_triangle: int) -> InstanceMesh:
    """Cluster vertices until the mesh is small enough.

    Unlike collapsing edges, this also reduces triangles without a common edge.
    """
    cell = 0.5 * _cell(mesh, max(1, len(mesh.triangles)))
    while bytes_of_vertex * len(mesh.vertices) + bytes_of_triangle * len(mesh.triangles) > most_bytes:
        mesh = _relabeled(_open3d(mesh).simplify_vertex_clustering(cell), mesh)
        cell *= COARSER
    return mesh


def triangle_labels(triangles: Int32, labels: Int32) -> Int32:
    """Return (F,) the label of at least two corners, else of the first; triangles (F, 3), labels (V,)."""
    corners = labels[triangles]
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def _collapsed(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Collapse edges by quadrics on a relief of the brightness, which preserves the texture of flat surfaces.

    Each remaining vertex is replaced by the nearest original one, with its color and labels.
    """
    model = _open3d(mesh)
    model.compute_vertex_normals()
    brightness = mesh.colors @ BRIGHTNESS / 255
    relief = mesh.vertices + RELIEF * brightness[:, None] * np.asarray(model.vertex_normals)
    model.vertices = _vectors(relief)
    model = model.simplify_quadric_decimation(triangles)
    model.remove_unreferenced_vertices()
    nearest = _nearest(relief, np.asarray(model.vertices))
    return InstanceMesh(
        mesh.vertices[nearest],
        np.asarray(model.triangles).astype(np.int32).reshape(-1, 3),
        mesh.colors[nearest],
        mesh.instance_ids[nearest],
        mesh.class_ids[nearest],
        mesh.classes,
    )


def _cell(mesh: InstanceMesh, count: int) -> float:
    """Return the cell size, m, that leaves about `count` triangles: two per square of the surface."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(float(np.sqrt(2 * area / count)), 1e-4)


def _open3d(mesh: InstanceMesh) -> Any:
    import open3d as o3d  # takes half a second to load

    model = o3d.geometry.TriangleMesh(_vectors(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles))
    model.vertex_colors = _vectors(mesh.colors / 255.0)
    return model


def _vectors(rows: Float32 | Float64) -> Any:
    import open3d as o3d

    return o3d.utility.Vector3dVector(rows.astype(np.float64))


def _relabeled(model: Any, mesh: InstanceMesh) -> InstanceMesh:
    """Convert a mesh of Open3D, each vertex with the labels of the nearest one of `mesh`."""
    model.remove_unreferenced_vertices()
    kept = np.asarray(model.vertices).astype(np.float32).reshape(-1, 3)
    nearest = _nearest(mesh.vertices, kept)
    colors = np.rint(255 * np.clip(np.asarray(model.vertex_colors), 0, 1)).astype(np.uint8).reshape(-1, 3)
    triangles = np.asarray(model.triangles).astype(np.int32).reshape(-1, 3)
    return InstanceMesh(kept, triangles, colors, mesh.instance_ids[nearest], mesh.class_ids[nearest], mesh.classes)


def _nearest(places: Float32 | Float64, asked: Float32 | Float64) -> Int64:
    """Return (N,) the index of the nearest of the places (M, 3) to each of those asked for (N, 3)."""
    if not len(asked):
        return np.zeros(0, np.int64)
    return np.asarray(cKDTree(places, balanced_tree=False).query(asked)[1])


def submesh(mesh: InstanceMesh, kept: Bool, triangles: Bool | None = None) -> InstanceMesh:
    """Return the mesh of some vertices (V,) and triangles (F,); None = all triangles between these vertices."""
    number = np.cumsum(kept, dtype=np.int32) - 1
    chosen = kept[mesh.triangles].all(axis=1) if triangles is None else triangles
    return InstanceMesh(
        mesh.vertices[kept],
        number[mesh.triangles[chosen]].astype(np.int32),
        mesh.colors[kept],
        mesh.instance_ids[kept],
        mesh.class_ids[kept],
        mesh.classes,
    )


def corners_of(mesh: InstanceMesh, triangles: Bool) -> Bool:
    """Return (V,), true for the vertices of the triangles (F,)."""
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[mesh.triangles[triangles]] = True
    return used


def joined(meshes: Sequence[InstanceMesh]) -> InstanceMesh:
    """Join at least one mesh of the same map."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return InstanceMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]).astype(np.int32),
        np.concatenate([mesh.colors for mesh in meshes]),
        np.concatenate([mesh.instance_ids for mesh in meshes]),
        np.concatenate([mesh.class_ids for mesh in meshes]),
        meshes[0].classes,
    )
