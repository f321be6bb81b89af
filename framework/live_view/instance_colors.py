"""Colors of instances in a growing map. Each instance keeps its color."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Bool, Float64, Frame, InstanceMesh, Int32, UInt8
from framework.geometry import inverse, project, transform
from framework.rendering.palette import instance_colors

TINT = 0.6  # fraction of the instance color in a vertex color; the rest is the vertex brightness


class InstanceColors:
    """Instance colors by id, from the palette of overview.png."""

    def __init__(self) -> None:
        self._centroids: dict[int, Float64] = {}  # (3,) m, at the first observation
        self._colors: dict[int, UInt8] = {}  # (3,) RGB

    def add(self, centroids: Mapping[int, Float64]) -> None:
        """Assign colors to new instances, given the centroid (3,) of each instance by id, m."""
        new = {key: centroids[key] for key in sorted(centroids.keys() - self._centroids.keys())}
        if new:
            self._centroids |= new
            colors = instance_colors(np.array([*self._centroids.values()], np.float64))
            self._colors = dict(zip(self._centroids, colors, strict=True))

    def __getitem__(self, instance_id: int) -> UInt8:
        return self._colors[instance_id]

    def get(self, instance_id: int, default: UInt8) -> UInt8:
        return self._colors.get(instance_id, default)

    def painted(self, mesh: InstanceMesh) -> UInt8:
        """Return the RGB vertex colors (V, 3) of a mesh, tinted with the instance colors."""
        palette = np.zeros((int(mesh.instance_ids.max(initial=0)) + 1, 3), np.float32)
        for key in np.unique(mesh.instance_ids[mesh.instance_ids > 0]).tolist():
            palette[key] = self._colors[key]
        chosen = mesh.instance_ids > 0
        gray = mesh.colors[chosen].mean(axis=1, keepdims=True, dtype=np.float32)
        colors = mesh.colors.copy()
        colors[chosen] = (1 - TINT) * gray + TINT * palette[mesh.instance_ids[chosen]]
        return colors


MAX_POINTS = 8_000  # maximum number of map points projected into a frame
NEAR = 0.05  # maximum difference between the depth of a point and the depth reading, relative to depth
MIN_FRACTION = 0.3  # minimum fraction of the points in a mask that belong to its instance


def seen_instances(masks: Bool, frame: Frame, T_world_camera: Float64, mesh: InstanceMesh) -> Int32:
    """Return the id (N,) of the instance in each mask (N, H, W), or 0 for no instance.

    Mesh vertices are projected into the frame and compared with its depth. The instance of a mask has the most vertices
    in the mask, and more than MIN_FRACTION of all vertices in the mask.
    """
    chosen = slice(None, None, -(-len(mesh.vertices) // MAX_POINTS) or 1)
    points_camera = transform(inverse(T_world_camera), mesh.vertices[chosen])
    ids = mesh.instance_ids[chosen]
    in_front = points_camera[:, 2] > 0
    points_camera, ids = points_camera[in_front], ids[in_front]
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
    return best if counts[best] > MIN_FRACTION * len(ids) else 0
