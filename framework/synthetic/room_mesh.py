"""Ground-truth mesh of a synthetic sequence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Camera, Float32, Float64, Int32, Int64
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.surfaces import Surfaces

# maximum distance of a hit, relative to the distance of the vertex; above 1 to include the surface at the vertex
ON_SURFACE = 1.001
LONGEST_EDGE = 0.02  # m, maximum edge length of the mesh


@dataclass(frozen=True)
class RoomMesh:
    """Triangle mesh with an instance id for each vertex."""

    vertices: Float32  # (V, 3) m, world frame
    triangles: Int32  # (F, 3) vertex indices, counterclockwise as seen from outside
    instance_ids: Int32  # (V,), 0 = floor, wall or ceiling

    def only(self, kept: Bool) -> RoomMesh:
        """Return the submesh of the vertices in a mask (V,)."""
        number = np.cumsum(kept, dtype=np.int32) - 1
        triangles = self.triangles[kept[self.triangles].all(axis=1)]
        return RoomMesh(self.vertices[kept], number[triangles], self.instance_ids[kept])


def visible_mesh(
    surfaces: Surfaces,
    caster: RayCaster,
    camera: Camera,
    poses: Iterable[Float64],
    reach: tuple[float, float],
    longest_edge: float = LONGEST_EDGE,
) -> RoomMesh:
    """Return the mesh of the surfaces that are visible from at least one pose.

    Surfaces without depth readings count as invisible, and so do surfaces behind them.

    Args:
        surfaces: The surfaces of the room.
        caster: The ray caster of the surfaces.
        camera: The camera of all poses.
        poses: The pose T_world_camera (4, 4) of each view.
        reach: The minimum and maximum depth of a visible surface, m.
        longest_edge: The maximum edge length of the mesh, m.
    """
    mesh = tessellate(surfaces, longest_edge)
    return mesh.only(seen_from(mesh.vertices, caster, camera, poses, reach, surfaces.unreadable))


def tessellate(surfaces: Surfaces, longest_edge: float) -> RoomMesh:
    """Subdivide the surfaces into triangles with a maximum edge length in m."""
    instance_ids = np.zeros(len(surfaces.vertices), np.int32)
    instance_ids[surfaces.triangles.ravel()] = np.repeat(surfaces.instance_ids, 3)
    mesh = _welded(RoomMesh(surfaces.vertices, surfaces.triangles, instance_ids))
    vertices, instance_ids, open_triangles = mesh.vertices, mesh.instance_ids, mesh.triangles
    done: list[Int32] = []
    while len(open_triangles):  # long edges are halved in all adjacent triangles, so that the mesh has no gaps
        corners = vertices[open_triangles]
        square = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=2)  # (F, 3)
        too_long = square.max(axis=1) > np.float32(longest_edge) ** 2
        done.append(open_triangles[~too_long])
        first = square[too_long].argmax(axis=1)[:, None]
        a, b, c = (np.take_along_axis(open_triangles[too_long], (first + k) % 3, axis=1)[:, 0] for k in range(3))
        edges, edge = np.unique(np.minimum(a, b) * np.int64(len(vertices)) + np.maximum(a, b), return_inverse=True)
        low, high = np.divmod(edges, len(vertices))
        middle = (edge + len(vertices)).astype(np.int32)
        vertices = np.concatenate([vertices, (vertices[low] + vertices[high]) / 2])
        instance_ids = np.concatenate([instance_ids, instance_ids[low]])
        open_triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return _welded(RoomMesh(vertices, np.concatenate(done), instance_ids))


def _welded(mesh: RoomMesh) -> RoomMesh:
    """Merge equal vertices of each instance and remove degenerate triangles."""
    rows = np.empty((len(mesh.vertices), 4), np.int32)
    rows[:, :3] = (mesh.vertices + np.float32(0)).view(np.int32)  # converts -0 to 0
    rows[:, 3] = mesh.instance_ids
    order = np.lexsort(rows.T)
    new = np.ones(len(rows), np.bool_)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    number = np.empty(len(rows), np.int32)
    number[order] = np.cumsum(new, dtype=np.int32) - 1
    triangles = number[mesh.triangles]
    a, b, c = triangles.T
    kept = order[new]
    return RoomMesh(
        mesh.vertices[kept], triangles[(a != b) & (b != c) & (c != a)], np.ascontiguousarray(mesh.instance_ids[kept])
    )


def seen_from(
    vertices: Float32,
    caster: RayCaster,
    camera: Camera,
    poses: Iterable[Float64],
    reach: tuple[float, float],
    unreadable: Bool,
) -> Bool:
    """Return the mask (V,) of the vertices that are visible from at least one pose.

    Args:
        vertices: The vertices (V, 3) in the world frame, m.
        caster: The ray caster of the surfaces.
        camera: The camera of all poses.
        poses: The pose T_world_camera (4, 4) of each view.
        reach: The minimum and maximum depth of a visible vertex, m.
        unreadable: The mask (F,) of the caster's triangles without depth readings. Vertices on these triangles or
            closely behind them are not visible.
    """
    seen = np.zeros(len(vertices), np.bool_)
    for T_world_camera in poses:
        candidates = _in_view(vertices, seen, camera, T_world_camera, reach)
        ends = vertices[candidates]
        origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), ends.shape)
        free = ~caster.occluded(origins, ends)
        hits = caster.cast(np.concatenate([origins, ends - origins], axis=1)[free])
        free[free] = ~(np.append(unreadable, False)[hits.triangle] & (hits.distance < ON_SURFACE))
        seen[candidates[free]] = True
    return seen


def _in_view(
    vertices: Float32, skip: Bool, camera: Camera, T_world_camera: Float64, reach: tuple[float, float]
) -> Int64:
    """Return the indices (N,) of the vertices in the field of view, without those in the mask `skip` (V,)."""
    index = np.flatnonzero(~skip)
    dx, dy, dz = vertices[index].T - T_world_camera[:3, 3:]
    x, y, z = (R[0] * dx + R[1] * dy + R[2] * dz for R in T_world_camera[:3, :3].T)
    near, far = reach
    ahead = (z > near) & (z <= far)
    index, x, y, z = index[ahead], x[ahead], y[ahead], z[ahead]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    height, width = camera.shape
    return np.asarray(index[(u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)])
