"""Meshes with fewer triangles: flat pictures stay what they are, and a huge map takes no longer than a large one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from framework.data import Float32, Float64, InstanceMesh, Int32, Int64
from framework.exporting.submeshes import corners_of, joined, submesh

OBJECTS_SHARE = 0.5  # of the triangles, that the objects may have
FEWEST = 4  # triangles, of a closed surface
QUADRIC_STEP = 2.5  # quadric decimation takes time by the square of this ratio: what has more is clustered first
LEFT_TO_QUADRIC = 1.8  # triangles after clustering, by those that are wanted
FEW = 20_000  # triangles: for fewer nothing is clustered; cubes would be as large as a thing, and the time is short
RELIEF = 0.03  # m, by which white stands out from black
BRIGHTNESS = np.array([0.299, 0.587, 0.114])  # of red, green and blue, ITU-R BT.601
COARSER = 1.3  # from one cell to the next one that is tried


def decimated(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """The mesh with at most so many triangles, at least FEWEST; one that has no more is returned as it is.

    Edges are collapsed where that changes the surface least: Garland and Heckbert, "Surface Simplification Using
    Quadric Error Metrics", SIGGRAPH 1997, by Open3D. Meshes that are much too large are clustered in cubes before.
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
    """The same, with the objects kept finer than what is around them.

    The two are decimated apart, so that their border stays where it is; vertices around objects lose their labels.
    """
    owners = triangle_labels(mesh.triangles, mesh.instance_ids)
    of_object = owners > 0
    counts = int(of_object.sum()), int((~of_object).sum())
    objects = min(counts[0], max(int(OBJECTS_SHARE * triangles), triangles - counts[1]))
    ids = mesh.instance_ids.copy()
    corners = mesh.triangles[of_object]
    bare = ids[corners] == 0  # on the border: a coarse triangle may have no others
    ids[corners[bare]] = np.broadcast_to(owners[of_object, None], corners.shape)[bare]
    found = submesh(replace(mesh, instance_ids=ids), corners_of(mesh, of_object), of_object)
    around = submesh(replace(mesh, instance_ids=np.zeros_like(ids)), corners_of(mesh, ~of_object), ~of_object)
    return joined([decimated(found, objects), decimated(around, triangles - objects)])


def clustered(mesh: InstanceMesh, most_bytes: int, bytes_of_vertex: int, bytes_of_triangle: int) -> InstanceMesh:
    """The mesh with vertices that are near to each other made one, until it is small enough.

    Unlike the collapsing of edges this always comes to an end: triangles that share no vertex have no edge in common.
    """
    cell = 0.5 * _cell(mesh, max(1, len(mesh.triangles)))
    while bytes_of_vertex * len(mesh.vertices) + bytes_of_triangle * len(mesh.triangles) > most_bytes:
        mesh = _relabeled(_open3d(mesh).simplify_vertex_clustering(cell), mesh)
        cell *= COARSER
    return mesh


def triangle_labels(triangles: Int32, labels: Int32) -> Int32:
    """(F,) the label that two corners have, else that of the first; triangles (F, 3), labels (V,)."""
    corners = labels[triangles]
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def _collapsed(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """Edges collapsed by quadrics, on a relief in which what is bright stands out: else flat pictures would be lost.

    Vertices that are left go back to the nearest ones of the mesh, so place, colour and labels are those of a vertex.
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
    """The side of the cubes, m, that leave about `count` triangles: two for each square of a surface."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(float(np.sqrt(2 * area / count)), 1e-4)


def _open3d(mesh: InstanceMesh) -> Any:
    import open3d as o3d  # here: it takes half a second to load

    model = o3d.geometry.TriangleMesh(_vectors(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles))
    model.vertex_colors = _vectors(mesh.colors / 255.0)
    return model


def _vectors(rows: Float32 | Float64) -> Any:
    import open3d as o3d

    return o3d.utility.Vector3dVector(rows.astype(np.float64))


def _relabeled(model: Any, mesh: InstanceMesh) -> InstanceMesh:
    """What Open3D made of a mesh, each vertex with the labels of the nearest one there."""
    model.remove_unreferenced_vertices()
    kept = np.asarray(model.vertices).astype(np.float32).reshape(-1, 3)
    nearest = _nearest(mesh.vertices, kept)
    colors = np.rint(255 * np.clip(np.asarray(model.vertex_colors), 0, 1)).astype(np.uint8).reshape(-1, 3)
    triangles = np.asarray(model.triangles).astype(np.int32).reshape(-1, 3)
    return InstanceMesh(kept, triangles, colors, mesh.instance_ids[nearest], mesh.class_ids[nearest], mesh.classes)


def _nearest(places: Float32 | Float64, asked: Float32 | Float64) -> Int64:
    """(N,) which of the places (M, 3) is the nearest to each of those asked for (N, 3)."""
    if not len(asked):
        return np.zeros(0, np.int64)
    return np.asarray(cKDTree(places, balanced_tree=False).query(asked)[1])
