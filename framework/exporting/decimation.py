"""A mesh with fewer triangles: quadric error metrics (Garland and Heckbert, SIGGRAPH 1997), as Open3D has them."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from scipy.spatial import KDTree

from framework.data import InstanceMesh


def decimated(mesh: InstanceMesh, triangles: int) -> InstanceMesh:
    """With about so many triangles, at least one. Colours are averaged; each vertex has the labels of the nearest one.

    A mesh that has no more is returned as it is.
    """
    if len(mesh.triangles) <= max(triangles, 1):
        return mesh
    full = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)), o3d.utility.Vector3iVector(mesh.triangles)
    )
    full.vertex_colors = o3d.utility.Vector3dVector(mesh.colors / 255.0)
    fewer = full.simplify_quadric_decimation(max(triangles, 1)).remove_unreferenced_vertices()
    vertices = np.asarray(fewer.vertices, np.float32)
    _, nearest = KDTree(mesh.vertices).query(vertices)
    return InstanceMesh(
        vertices,
        np.asarray(fewer.triangles, np.int32),
        np.rint(np.clip(np.asarray(fewer.vertex_colors), 0, 1) * 255).astype(np.uint8),
        mesh.instance_ids[nearest],
        mesh.class_ids[nearest],
        mesh.classes,
    )
