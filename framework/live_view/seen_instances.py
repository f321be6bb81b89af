"""Which instance of the map is under each mask of a frame."""

from __future__ import annotations

import numpy as np

from framework.data import Bool, Float64, Frame, InstanceMesh, Int32
from framework.geometry import inverse, project, transform

MOST_POINTS = 8_000  # of the map, that are looked for in a frame
NEAR = 0.05  # of the depth, by which a point may lie before or behind the reading
LEAST_SHARE = 0.3  # of the points under a mask, that its instance has


def seen_instances(masks: Bool, frame: Frame, T_world_camera: Float64, mesh: InstanceMesh) -> Int32:
    """(N,) the instance that most of the points under each mask (N, H, W) belong to, 0 where none has enough of them.

    The points are vertices of the mesh, with or without an instance, that lie where the frame has its readings.
    """
    chosen = slice(None, None, -(-len(mesh.vertices) // MOST_POINTS) or 1)
    points_camera = transform(inverse(T_world_camera), mesh.vertices[chosen])
    ids = mesh.instance_ids[chosen]
    before = points_camera[:, 2] > 0
    points_camera, ids = points_camera[before], ids[before]
    u, v = np.rint(project(frame.camera, points_camera)).astype(np.int64).T
    height, width = frame.camera.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v, ids, z = u[inside], v[inside], ids[inside], points_camera[inside, 2]
    depth = frame.depth[v, u]
    seen = np.abs(depth - z) < NEAR * depth
    u, v, ids = u[seen], v[seen], ids[seen]
    return np.array([_most(ids[mask[v, u]]) for mask in masks], np.int32)


def _most(ids: Int32) -> int:
    counts = np.bincount(ids, minlength=1)
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] > LEAST_SHARE * len(ids) else 0
