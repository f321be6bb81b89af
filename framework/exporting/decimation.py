"""Mesh decimation, and functions to split and join meshes.

Decimation preserves the texture of flat surfaces and is fast for large meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from framework.data import Bool, Float32, Float64, InstanceMesh, Int32, Int64

OBJECTS_FRACTION = 0.5  # minimum fraction of the triangle limit that is reserved for objects
MIN_TRIANGLES = 4  # minimum number of triangles of a closed surface
QUADRIC_STEP = 2.5  # maximum reduction factor of quadric decimation; its run time is quadratic in the factor
LEFT_TO_QUADRIC = 1.8  # ratio of the triangles after clustering to the triangles after quadric decimation
MIN_CLUSTERED = 20_000  # minimum number of triangles after clustering; with fewer, cells would be as large as objects
RELIEF = 0.03  # m, offset of white vertices relative to black vertices along the normal
BRIGHTNESS = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue, ITU-R BT.601
COARSER = 1.3  # ratio of successive cell sizes


def decimated(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Decimate a mesh to at most `triangles` triangles.

    Large meshes are first simplified by vertex clustering. Quadric decimation follows (Garland and Heckbert, "Surface
    Simplification Using Quadric Error Metrics", SIGGRAPH 1997).
    """
    most = max(triangles, MIN_TRIANGLES)
    wanted = max(most, MIN_CLUSTERED)
    if len(mesh.triangles) > QUADRIC_STEP * wanted:
        cell, model = _cell(mesh, int(LEFT_TO_QUADRIC * wanted)), _open3d(mesh)
        model = model.simplify_vertex_clustering(cell)
        while len(model.triangles) > QUADRIC_STEP * wanted:
            cell *= COARSER
            model = model.simplify_vertex_clustering(cell)
        mesh = _relabeled(model, mesh)
    return _collapsed(mesh, most) if len(mesh.triangles) > most else mesh


def with_finer_objects(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Decimate a mesh to about `triangles` triangles, with finer objects than background.

    Objects and background are decimated separately, which preserves the border between them. Background vertices get
    the label 0.
    """
    owners = triangle_labels(mesh.triangles, mesh.instance_ids)
    of_object = owners > 0
    counts = int(of_object.sum()), int((~of_object).sum())
    objects = min(counts[0], max(int(OBJECTS_FRACTION * triangles), triangles - counts[1]))
    ids = mesh.instance_ids.copy()
    corners = mesh.triangles[of_object]
    bare = ids[corners] == 0  # corners on the border; all corners of a coarse triangle may be on the border
    ids[corners[bare]] = np.broadcast_to(owners[of_object, None], corners.shape)[bare]
    found = submesh(replace(mesh, instance_ids=ids), corners_of(mesh, of_object), of_object)
    around = submesh(replace(mesh, instance_ids=np.zeros_like(ids)), corners_of(mesh, ~of_object), ~of_object)
    return joined([decimated(found, objects), decimated(around, triangles - objects)])


def clustered(mesh: InstanceMesh, most_bytes: int, bytes_of_vertex: int, bytes_of_triangle: int) -> InstanceMesh:
    """Simplify a mesh by vertex clustering until its stored size is small enough.

    Unlike edge collapse, vertex clustering also merges triangles without a common edge.

    Args:
        mesh: Input mesh.
        most_bytes: Maximum stored size of the result, bytes.
        bytes_of_vertex: Stored size of one vertex, bytes.
        bytes_of_triangle: Stored size of one triangle, bytes.
    """
    cell = 0.5 * _cell(mesh, max(1, len(mesh.triangles)))
    while bytes_of_vertex * len(mesh.vertices) + bytes_of_triangle * len(mesh.triangles) > most_bytes:
        mesh = _relabeled(_open3d(mesh).simplify_vertex_clustering(cell), mesh)
        cell *= COARSER
    return mesh


def triangle_labels(triangles: Int32, labels: Int32) -> Int32:
    """Return the majority label (F,) of the vertices of each triangle.

    If all three labels differ, the first one is used.

    Args:
        triangles: Vertex indices (F, 3).
        labels: Vertex labels (V,).
    """
    corners = labels[triangles]
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def _collapsed(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Simplify a mesh to at most `triangles` triangles by quadric decimation."""
    model = _open3d(mesh)
    model.compute_vertex_normals()
    # bright vertices are moved along their normals, so that decimation preserves the texture of flat surfaces
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
        None if mesh.structure is None else mesh.structure[nearest],
    )


def _cell(mesh: InstanceMesh, count: int) -> float:
    """Return the cell size for about `count` triangles after vertex clustering, m."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(float(np.sqrt(2 * area / count)), 1e-4)  # two triangles per square cell of the surface


def _open3d(mesh: InstanceMesh) -> Any:
    import open3d as o3d  # takes half a second to load

    model = o3d.geometry.TriangleMesh(_vectors(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles))
    model.vertex_colors = _vectors(mesh.colors / 255.0)
    return model


def _vectors(rows: Float32 | Float64) -> Any:
    import open3d as o3d

    return o3d.utility.Vector3dVector(rows.astype(np.float64))


def _relabeled(model: Any, mesh: InstanceMesh) -> InstanceMesh:
    """Convert an Open3D mesh. Each vertex gets the labels of the nearest vertex of `mesh`."""
    model.remove_unreferenced_vertices()
    kept = np.asarray(model.vertices).astype(np.float32).reshape(-1, 3)
    nearest = _nearest(mesh.vertices, kept)
    colors = np.rint(255 * np.clip(np.asarray(model.vertex_colors), 0, 1)).astype(np.uint8).reshape(-1, 3)
    triangles = np.asarray(model.triangles).astype(np.int32).reshape(-1, 3)
    structure = None if mesh.structure is None else mesh.structure[nearest]
    ids, class_ids = mesh.instance_ids[nearest], mesh.class_ids[nearest]
    return InstanceMesh(kept, triangles, colors, ids, class_ids, mesh.classes, structure)


def _nearest(points: Float32 | Float64, queries: Float32 | Float64) -> Int64:
    """Return the index (N,) of the point nearest to each query point (N, 3)."""
    if not len(queries):
        return np.zeros(0, np.int64)
    return np.asarray(cKDTree(points, balanced_tree=False).query(queries)[1])


def submesh(mesh: InstanceMesh, kept: Bool, triangles: Bool | None = None) -> InstanceMesh:
    """Return the part of a mesh with the selected vertices and triangles.

    Args:
        mesh: Input mesh.
        kept: Mask (V,) of the selected vertices.
        triangles: Mask (F,) of the selected triangles; None = all triangles between selected vertices.
    """
    number = np.cumsum(kept, dtype=np.int32) - 1
    chosen = kept[mesh.triangles].all(axis=1) if triangles is None else triangles
    return InstanceMesh(
        mesh.vertices[kept],
        number[mesh.triangles[chosen]].astype(np.int32),
        mesh.colors[kept],
        mesh.instance_ids[kept],
        mesh.class_ids[kept],
        mesh.classes,
        None if mesh.structure is None else mesh.structure[kept],
    )


def corners_of(mesh: InstanceMesh, triangles: Bool) -> Bool:
    """Return the mask (V,) of the vertices of the triangles in a mask (F,)."""
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[mesh.triangles[triangles]] = True
    return used


def joined(meshes: Sequence[InstanceMesh]) -> InstanceMesh:
    """Concatenate one or more meshes with the same classes."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    structure = [mesh.structure for mesh in meshes if mesh.structure is not None]
    return InstanceMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]).astype(np.int32),
        np.concatenate([mesh.colors for mesh in meshes]),
        np.concatenate([mesh.instance_ids for mesh in meshes]),
        np.concatenate([mesh.class_ids for mesh in meshes]),
        meshes[0].classes,
        np.concatenate(structure) if len(structure) == len(meshes) else None,
    )
