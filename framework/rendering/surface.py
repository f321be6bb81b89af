"""Oriented triangle surfaces and their views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from framework.data import Bool, Camera, Float32, Float64, Int32
from framework.rendering.rasterizer import Rasterizer, VisibilityBuffer
from framework.rendering.rasterizer_kernels import NO_TRIANGLE, interpolate

VOTES, VOTERS = 20000, 50  # approximate numbers of sampled triangles and cameras to determine the front side


@dataclass(frozen=True)
class Hits:
    """The visible surface point at each pixel of a camera."""

    camera: Camera
    buffer: VisibilityBuffer
    vertices: Float32  # (V, 3) m, in the world frame
    triangles: Int32  # (F, 3) vertex indices; `buffer` contains indices into this array

    @property
    def depth(self) -> Float32:
        """Depth (H, W), m, 0 = none."""
        return self.buffer.depth

    @property
    def seen(self) -> Bool:
        """Mask (H, W) of the pixels with a surface."""
        return np.asarray(self.buffer.triangle != NO_TRIANGLE)

    @property
    def points_world(self) -> Float32:
        """World points (H, W, 3), m, 0 = none."""
        return self.interpolated(self.vertices)

    def subsampled(self, n: int) -> Hits:
        """Return the visible surface points of every n-th column and row."""
        seen, c = self.buffer, self.camera
        triangle, depth = np.ascontiguousarray(seen.triangle[::n, ::n]), np.ascontiguousarray(seen.depth[::n, ::n])
        height, width = depth.shape
        camera = Camera(width, height, c.fx / n, c.fy / n, c.cx / n, c.cy / n)
        buffer = VisibilityBuffer(triangle, depth, np.ascontiguousarray(seen.uv[::n, ::n]))
        return replace(self, camera=camera, buffer=buffer)

    def interpolated(self, values: Float32) -> Float32:
        """Return the interpolated vertex values (H, W, C) at each pixel, 0 = no surface."""
        image = np.zeros((*self.camera.shape, values.shape[1]), np.float32)
        interpolate(self.buffer.triangle, self.buffer.uv, self.triangles, np.ascontiguousarray(values), image)
        return image

    def nearest(self, labels: Int32) -> Int32:
        """Return the label (H, W) of the vertex with the largest barycentric weight at each pixel, 0 = none."""
        return self.buffer.nearest(self.triangles, labels)


class Surface:
    """Triangle mesh with a front side, which is defined by the winding order."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        self.vertices = np.ascontiguousarray(vertices, np.float32)  # (V, 3) m, world frame
        self.triangles = np.ascontiguousarray(triangles, np.int32)  # (F, 3) vertex indices

    @classmethod
    def seen_from(cls, vertices: Float32, triangles: Int32, poses: Float64) -> Surface:
        """Return the surface whose front side faces the cameras.

        Mesh extractors use different winding orders, so the order is reversed if necessary.

        Args:
            vertices: The vertices (V, 3) in the world frame, m.
            triangles: The triangles (F, 3).
            poses: The camera poses (P, 4, 4).
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
        """Face normals (F, 3) in the world frame, with twice the area of the triangle, m^2, as length."""
        a, b, c = self.vertices[self.triangles].transpose(1, 0, 2)
        return np.cross(b - a, c - a)

    @cached_property
    def vertex_normals(self) -> Float32:
        """Unit normals (V, 3) in the world frame, the area-weighted mean over adjacent triangles."""
        corners, weights = self.triangles.ravel(), np.repeat(self.face_normals, 3, axis=0)
        x, y, z = (np.bincount(corners, weights[:, k], minlength=len(self.vertices)) for k in range(3))
        length = np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-12)
        return np.stack([x / length, y / length, z / length], axis=1).astype(np.float32)


class FrontSides:
    """The triangles of a surface that face a viewpoint.

    Walls and ceilings seen from behind are omitted.
    """

    def __init__(self, surface: Surface, eye_world: Float64) -> None:
        self._eye_world = eye_world  # (3,) m, position of the viewpoint
        self._vertices = surface.vertices
        rays = surface.vertices[surface.triangles[:, 0]] - eye_world.astype(np.float32)
        x, y, z = (surface.face_normals * rays).T
        self._triangles = surface.triangles[x + y + z < 0]
        self._rasterizer = Rasterizer(self._vertices, self._triangles)

    def seen_by(self, camera: Camera, R_world_camera: Float64) -> Hits:
        """Return the visible surface points of a camera at the viewpoint with the given rotation (3, 3)."""
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3], T_world_camera[:3, 3] = R_world_camera, self._eye_world
        return Hits(camera, self._rasterizer.draw(camera, T_world_camera), self._vertices, self._triangles)
