"""Meshes made light enough for a browser: fewer triangles, with the objects kept finer than what is around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from framework.data import Bool, Float32, Float64, InstanceMesh, Int32, UInt8

OBJECTS_SHARE = 0.5  # of the triangles, that the objects may have
QUADRIC_STEP = 2.5  # quadric decimation takes time by the square of this ratio: what has more is clustered first
LEFT_TO_QUADRIC = 1.8  # triangles after clustering, by those that are wanted
RELIEF = 0.03  # m, by which white stands out from black
BRIGHTNESS = np.array([0.299, 0.587, 0.114])  # of red, green and blue, ITU-R BT.601
COARSER = 1.3  # from one cell to the next one that is tried


@dataclass(frozen=True)
class LightMesh:
    """A decimated map: V vertices, F triangles."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    colors: UInt8  # (V, 3) RGB
    instance_ids: Int32  # (V,) 0 = of no object


def decimated(mesh: InstanceMesh, instance_ids: Int32, most_triangles: int) -> LightMesh:
    """The mesh with at most so many triangles: edges are collapsed where that changes the surface least.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997, by Open3D. Meshes that
    are much too large are clustered in cubes before. Objects and what is around them are decimated apart, so that
    their border stays where it is; colours are averaged, and each vertex has the label of the nearest one before.

    Args:
        instance_ids: (V,) of the mesh's vertices, 0 = of no object.
    """
    labels = instance_ids[mesh.triangles]
    of_object = np.where(labels[:, 1] == labels[:, 2], labels[:, 1], labels[:, 0]) > 0
    counts = int(of_object.sum()), int((~of_object).sum())
    objects = min(counts[0], max(int(OBJECTS_SHARE * most_triangles), most_triangles - counts[1]))
    parts = [
        _decimated_part(mesh, instance_ids, of_object, objects),
        _decimated_part(mesh, np.zeros_like(instance_ids), ~of_object, most_triangles - objects),
    ]
    return _joined(parts)


def clustered(mesh: LightMesh, most_bytes: int, bytes_of_vertex: int, bytes_of_triangle: int) -> LightMesh:
    """The mesh with vertices that are near to each other made one, until it is small enough.

    Unlike the collapsing of edges this always comes to an end: triangles that share no vertex have no edge in common.
    """
    cell = 0.5 * _cell(mesh.vertices, mesh.triangles, max(1, len(mesh.triangles)))
    while bytes_of_vertex * len(mesh.vertices) + bytes_of_triangle * len(mesh.triangles) > most_bytes:
        mesh = _relabeled(_open3d(mesh).simplify_vertex_clustering(cell), mesh.vertices, mesh.instance_ids)
        cell *= COARSER
    return mesh


def _decimated_part(mesh: InstanceMesh, instance_ids: Int32, chosen: Bool, most_triangles: int) -> LightMesh:
    """The chosen triangles (F,) of a mesh."""
    used, triangles = np.unique(mesh.triangles[chosen], return_inverse=True)
    part = LightMesh(
        mesh.vertices[used], triangles.reshape(-1, 3).astype(np.int32), mesh.colors[used], instance_ids[used]
    )
    if len(part.triangles) <= most_triangles:
        return part
    if len(part.triangles) > QUADRIC_STEP * most_triangles:
        cell, model = _cell(part.vertices, part.triangles, int(LEFT_TO_QUADRIC * most_triangles)), _open3d(part)
        model = model.simplify_vertex_clustering(cell)
        while len(model.triangles) > QUADRIC_STEP * most_triangles:
            cell *= COARSER
            model = model.simplify_vertex_clustering(cell)
        part = _relabeled(model, part.vertices, part.instance_ids)
    return _collapsed(part, most_triangles) if len(part.triangles) > most_triangles else part


def _collapsed(mesh: LightMesh, most_triangles: int) -> LightMesh:
    """Edges collapsed by quadrics, on a relief in which what is bright stands out: else flat pictures would be lost.

    Vertices that are left go back to the nearest ones of the mesh, so place, colour and label are those of a vertex.
    """
    model = _open3d(mesh)
    model.compute_vertex_normals()
    brightness = mesh.colors @ BRIGHTNESS / 255
    relief = mesh.vertices + RELIEF * brightness[:, None] * np.asarray(model.vertex_normals)
    model.vertices = _vectors(relief)
    model = model.simplify_quadric_decimation(max(most_triangles, 4))
    model.remove_unreferenced_vertices()
    _, nearest = cKDTree(relief, balanced_tree=False).query(np.asarray(model.vertices))
    triangles = np.asarray(model.triangles).astype(np.int32).reshape(-1, 3)
    return LightMesh(mesh.vertices[nearest], triangles, mesh.colors[nearest], mesh.instance_ids[nearest])


def _cell(vertices: Float32, triangles: Int32, count: int) -> float:
    """The side of the cubes, m, that leave about `count` triangles: two for each square of a surface."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(float(np.sqrt(2 * area / count)), 1e-4)


def _open3d(mesh: LightMesh) -> Any:
    import open3d as o3d  # here: it takes half a second to load

    model = o3d.geometry.TriangleMesh(_vectors(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles))
    model.vertex_colors = _vectors(mesh.colors / 255.0)
    return model


def _vectors(rows: Float32 | Float64) -> Any:
    import open3d as o3d

    return o3d.utility.Vector3dVector(rows.astype(np.float64))


def _relabeled(model: Any, vertices: Float32, instance_ids: Int32) -> LightMesh:
    """What Open3D made of labelled vertices (V, 3), each with the label (V,) of the nearest of those."""
    model.remove_unreferenced_vertices()
    kept = np.asarray(model.vertices).astype(np.float32)
    if instance_ids.any() and len(kept):
        _, nearest = cKDTree(vertices, balanced_tree=False).query(kept)
        labels = instance_ids[nearest]
    else:
        labels = np.zeros(len(kept), np.int32)
    colors = np.rint(255 * np.clip(np.asarray(model.vertex_colors), 0, 1)).astype(np.uint8).reshape(-1, 3)
    return LightMesh(kept.reshape(-1, 3), np.asarray(model.triangles).astype(np.int32).reshape(-1, 3), colors, labels)


def _joined(parts: list[LightMesh]) -> LightMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return LightMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        np.concatenate([part.colors for part in parts]),
        np.concatenate([part.instance_ids for part in parts]),
    )
