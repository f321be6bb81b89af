"""Decimated maps as GLB files, with one node per object and one background node."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Float32, Float64, InstanceMesh
from framework.exporting.decimation import clustered, corners_of, submesh, triangle_labels
from framework.exporting.glb import T_GLTF_ROOM, Node, glb_of
from framework.exporting.object_meshes import REST
from framework.exporting.upright_room import plain_name, upright

MAX_BYTES = 9_500_000  # maximum size of the file, bytes, for mobile browsers
BYTES_OF_VERTEX = 24  # bytes of position, color and first view
BYTES_OF_TRIANGLE = 12  # bytes of three indices
MAX_TRIANGLES = 300_000  # maximum number of triangles; with their vertices, about 7 MB
NOT_GEOMETRY = 200_000  # bytes reserved for names and nodes
FIRST_SEEN = "_FIRST_SEEN"  # name of the vertex attribute with the values of `first_seen`


def scene_glb(mesh: InstanceMesh, first_seen: Float32, names: Mapping[int, str], up: Float64) -> bytes:
    """Return a map as an unlit GLB file (binary glTF 2.0).

    The vertices have world coordinates, and the matrix of each node rotates them upright. The metadata (`extras`) of an
    object node contains its id and class. The file of a `light_enough` mesh has at most MAX_BYTES bytes.

    Args:
        mesh: Mesh of the map.
        first_seen: Fraction (V,) of the sequence before the first view of each vertex, in [0, 1]; 1 = never visible. It
            is stored as the attribute `_FIRST_SEEN`.
        names: Class name by id, for the objects with a node.
        up: Up direction (3,) in the world frame, a unit vector.
    """
    labels = np.where(np.isin(mesh.instance_ids, list(names)), mesh.instance_ids, 0).astype(np.int32)
    of_triangle = triangle_labels(mesh.triangles, labels)
    T_gltf_world = T_GLTF_ROOM @ upright(up, 0.0, np.zeros(3))
    nodes = []
    for key in (0, *sorted(names)):
        chosen = of_triangle == key
        if chosen.any():
            used = corners_of(mesh, chosen)
            part = submesh(mesh, used, chosen)
            name, extras = (plain_name(names[key], key), {"id": key, "class": names[key]}) if key else (REST, {})
            seen = {FIRST_SEEN: first_seen[used].astype(np.float32)}
            nodes.append(Node(name, part.vertices, part.triangles, part.colors, T_gltf_world, not key, extras, seen))
    return glb_of(nodes, lit=False)


def light_enough(mesh: InstanceMesh, most_bytes: int = MAX_BYTES) -> InstanceMesh:
    """Simplify a mesh, so that its GLB file has at most `most_bytes` bytes."""
    return clustered(mesh, most_bytes - NOT_GEOMETRY, BYTES_OF_VERTEX, BYTES_OF_TRIANGLE)
