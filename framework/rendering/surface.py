"""Pictures of a triangle surface by rasterization: no window system, no OpenGL."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from framework.data import Bool, Camera, Float32, Float64, Int32
from framework.rendering.rasterizer import Rasterizer, VisibilityBuffer
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.rendering.surface_kernels import interpolate

VOTES = 20000  # triangles that are asked which of their sides was seen
VOTERS = 50  # cameras that are asked


@dataclass(frozen=True)
class Hits:
    """What each pixel of a camera sees of a surface."""

    camera: Camera
    buffer: VisibilityBuffer
    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3), those that `buffer` counts

    @property
    def depth(self) -> Float32:
        """(H, W) m along z, 0 = nothing."""
        return self.buffer.depth

    @property
    def seen(self) -> Bool:
        """(H, W)."""
        return np.asarray(self.buffer.triangle != NO_TRIANGLE)

    @property
    def points_world(self) -> Float32:
        """(H, W, 3) m, 0 where nothing is seen."""
        return self.interpolated(self.vertices)

    def subsampled(self, n: int) -> Hits:
        """The picture of each n-th pixel."""
        seen, c = self.buffer, self.camera
        triangle, depth = np.ascontiguousarray(seen.triangle[::n, ::n]), np.ascontiguousarray(seen.depth[::n, ::n])
        height, width = depth.shape
        camera = Camera(width, height, c.fx / n, c.fy / n, c.cx / n, c.cy / n)
        buffer = VisibilityBuffer(triangle, depth, np.ascontiguousarray(seen.uv[::n, ::n]))
        return replace(self, camera=camera, buffer=buffer)

    def interpolated(self, values: Float32) -> Float32:
        """(H, W, C) of values (V, C) at the vertices, 0 where nothing is seen."""
        image = np.zeros((*self.camera.shape, values.shape[1]), np.float32)
        interpolate(self.buffer.triangle, self.buffer.uv, self.triangles, np.ascontiguousarray(values), image)
        return image

    def nearest(self, labels: Int32) -> Int32:
        """(H, W) the label (V,) of the nearest corner, 0 where nothing is seen."""
        return self.buffer.nearest(self.triangles, labels)


class Surface:
    """Triangles whose winding says which side is the front: the side that was seen."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        self.vertices = np.ascontiguousarray(vertices, np.float32)  # (V, 3) m
        self.triangles = np.ascontiguousarray(triangles, np.int32)  # (F, 3)

    @classmethod
    def seen_from(cls, vertices: Float32, triangles: Int32, poses: Float64) -> Surface:
        """The surface wound so that most of what lies before the cameras at `poses` (F, 4, 4) shows them its front.

        Mesh extractors do not agree on the winding.
        """
        some = cls(vertices, triangles[:: max(1, len(triangles) // VOTES)])
        centers = vertices[some.triangles].mean(axis=1)
        votes = 0.0
        for T_world_camera in poses[:: max(1, len(poses) // VOTERS)]:
            rays = centers - T_world_camera[:3, 3]
            distance = np.linalg.norm(rays, axis=1)
            ahead = rays @ T_world_camera[:3, 2] > 0.8 * distance
            towards = -(some.face_normals * rays).sum(axis=1)[ahead] / np.maximum(distance[ahead], 1e-6) ** 3
            votes += float(towards.sum())
        return cls(vertices, triangles if votes >= 0 else triangles[:, ::-1])

    @cached_property
    def face_normals(self) -> Float32:
        """(F, 3), length = twice the area, so that sums of them weigh by area."""
        a, b, c = self.vertices[self.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @cached_property
    def vertex_normals(self) -> Float32:
        """(V, 3) unit length, averaged over the triangles around each vertex by area."""
        corners, weights = self.triangles.ravel(), np.repeat(self.face_normals, 3, axis=0)
        x, y, z = (np.bincount(corners, weights[:, k], minlength=len(self.vertices)) for k in range(3))
        length = np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-12)
        return np.stack([x / length, y / length, z / length], axis=1).astype(np.float32)


class FrontSides:
    """The triangles of a surface that face an eye: not the walls and ceilings between it and the room."""

    def __init__(self, surface: Surface, eye_world: Float64) -> None:
        self._eye_world = eye_world  # (3,) m
        self._vertices = surface.vertices
        rays = surface.vertices[surface.triangles[:, 0]] - eye_world.astype(np.float32)
        x, y, z = (surface.face_normals * rays).T
        self._triangles = surface.triangles[x + y + z < 0]
        self._rasterizer = Rasterizer(self._vertices, self._triangles)

    def seen_by(self, camera: Camera, R_world_camera: Float64) -> Hits:
        """What a camera at the eye sees along each pixel's ray."""
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3], T_world_camera[:3, 3] = R_world_camera, self._eye_world
        return Hits(camera, self._rasterizer.draw(camera, T_world_camera), self._vertices, self._triangles)
