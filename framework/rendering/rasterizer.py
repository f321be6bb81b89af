"""Rasterizer of triangle meshes.

Edge functions are evaluated in homogeneous coordinates, as in Olano and Greer, "Triangle Scan Conversion Using 2D
Homogeneous Coordinates", Graphics Hardware 1997. No clipping is needed, and adjacent triangles leave no gap. For small
triangles, the rasterizer is several times faster than ray casting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Camera, Float32, Float64, Int32
from framework.rendering.rasterizer_kernels import bounding_spheres, draw_triangles, morton_codes, nearest


@dataclass(frozen=True)
class VisibilityBuffer:
    """The visible triangle at each pixel."""

    triangle: Int32  # (H, W) index of the triangle, NO_TRIANGLE = none
    depth: Float32  # (H, W) m along z, 0 = none
    uv: Float32  # (H, W, 2) barycentric weights of the second and third vertex

    def nearest(self, triangles: Int32, labels: Int32) -> Int32:
        """Return the label (H, W) of the vertex with the largest barycentric weight at each pixel, 0 = none.

        Args:
            triangles: The triangles (F, 3) of the mesh.
            labels: The label (V,) of each vertex.
        """
        image = np.zeros(self.triangle.shape, np.int32)
        nearest(self.triangle, self.uv, triangles, labels, image)
        return image


class Rasterizer:
    """Thread-safe rasterizer of a triangle mesh."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        """Prepare a mesh of vertices (V, 3), m, and two-sided triangles (F, 3)."""
        self._vertices = np.ascontiguousarray(vertices, np.float32)
        # spatial order improves culling and cache locality
        self._order = np.argsort(morton_codes(self._vertices, triangles), kind="stable").astype(np.int32)
        self._triangles = triangles.astype(np.int32, copy=False)[self._order]
        self._spheres = bounding_spheres(self._vertices, self._triangles)

    def draw(self, camera: Camera, T_world_camera: Float64) -> VisibilityBuffer:
        """Return the nearest triangle at each pixel of a camera with the given pose (4, 4).

        Ties in depth are resolved deterministically.
        """
        triangle = np.empty(camera.shape, np.int32)
        depth = np.empty(camera.shape, np.float32)
        uv = np.empty((*camera.shape, 2), np.float32)
        draw_triangles(
            self._vertices,
            self._triangles,
            self._order,
            self._spheres,
            np.ascontiguousarray(T_world_camera, np.float64),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            (np.arange(camera.width) - camera.cx) / camera.fx,
            (np.arange(camera.height) - camera.cy) / camera.fy,
            triangle,
            depth,
            uv,
        )
        return VisibilityBuffer(triangle, depth, uv)
