"""Division of the mesh of an instance into parts."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from framework.data import InstanceMesh, Int32
from framework.editing.edits import SplitBy
from framework.errors import DataError
from framework.mapping.instances.instance_list import Confirmation, vertices_of_area

MIN_AREA = Confirmation.min_area  # minimum surface area of a part, m^2
PLANE_DISTANCE = 1.5  # maximum distance of a vertex from the dominant plane, voxels
PLANE_SAMPLES = 1000  # number of RANSAC iterations


def parts_of(mesh: InstanceMesh, by: SplitBy, voxel_size: float) -> Int32:
    """Return the part (V,) of each vertex, in descending order of size from 0; -1 = in a part that is too small.

    Args:
        mesh: The mesh of an instance.
        by: The criterion.
        voxel_size: The voxel size of the map, m.

    Raises:
        DataError: The mesh has fewer than two parts.
    """
    labels = _connected(mesh) if by is SplitBy.PARTS else _on_plane(mesh, PLANE_DISTANCE * voxel_size)
    sizes, min_vertices = np.bincount(labels), vertices_of_area(MIN_AREA, voxel_size)
    order = np.argsort(-sizes, kind="stable")
    large = order[sizes[order] >= min_vertices]
    if len(large) < 2:
        expected = f"at least two parts with {min_vertices} or more vertices ({MIN_AREA} m^2)"
        shown = ", ".join(map(str, sizes[order][:3]))
        raise DataError(f"expected {expected}, got parts with {shown} vertices; split by another criterion")
    number = np.full(len(sizes), -1, np.int32)
    number[large] = np.arange(len(large), dtype=np.int32)
    return number[labels]


def _connected(mesh: InstanceMesh) -> Int32:
    """Return the connected component (V,) of each vertex."""
    edges = np.concatenate([mesh.triangles[:, :2], mesh.triangles[:, 1:]]).T
    graph = coo_array((np.ones(edges.shape[1], np.bool_), tuple(edges)), shape=(len(mesh.vertices),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _on_plane(mesh: InstanceMesh, distance: float) -> Int32:
    """Return 0 for each vertex (V,) on the dominant plane, 1 for the others.

    Args:
        mesh: The mesh.
        distance: The maximum distance of a vertex from the plane, m.
    """
    import open3d as o3d  # takes 0.5 s

    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)))
    _, inliers = cloud.segment_plane(distance, ransac_n=3, num_iterations=PLANE_SAMPLES, probability=1.0)
    labels = np.ones(len(mesh.vertices), np.int32)
    labels[np.asarray(inliers, np.int64)] = 0
    return labels
