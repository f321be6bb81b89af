"""The colours of instances that come one after the other: each keeps the one that it got."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Bool, Float64, Frame, InstanceMesh, Int32, UInt8
from framework.geometry import inverse, project, transform
from framework.rendering.palette import instance_colors

TINT = 0.6  # of the instance's colour, in that of its vertices; the rest is their own brightness


class InstanceColors:
    """The palette of overview.png, by instance."""

    def __init__(self) -> None:
        self._centroids: dict[int, Float64] = {}  # (3,) m, where each was when it was first seen
        self._colors: dict[int, UInt8] = {}  # (3,) RGB

    def add(self, centroids: Mapping[int, Float64]) -> None:
        """Takes instances with their centroids (3,) m; those that are known keep their colour."""
        new = {key: centroids[key] for key in sorted(centroids.keys() - self._centroids.keys())}
        if new:
            self._centroids |= new
            everything = instance_colors(np.array([*self._centroids.values()], np.float64))
            self._colors = dict(zip(self._centroids, everything, strict=True))

    def __getitem__(self, instance_id: int) -> UInt8:
        return self._colors[instance_id]

    def painted(self, mesh: InstanceMesh) -> UInt8:
        """(V, 3) RGB of a mesh's vertices: their own colours, and those of the instances where they have one."""
        palette = np.zeros((int(mesh.instance_ids.max(initial=0)) + 1, 3), np.float32)
        for key in np.unique(mesh.instance_ids[mesh.instance_ids > 0]).tolist():
            palette[key] = self._colors[key]
        chosen = mesh.instance_ids > 0
        gray = mesh.colors[chosen].mean(axis=1, keepdims=True, dtype=np.float32)
        colors = mesh.colors.copy()
        colors[chosen] = (1 - TINT) * gray + TINT * palette[mesh.instance_ids[chosen]]
        return colors

    def known(self) -> Mapping[int, UInt8]:
        """RGB (3,) by instance."""
        return self._colors


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
