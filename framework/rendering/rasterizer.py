"""What of a triangle mesh a camera sees, by rasterization: for small triangles several times cheaper than ray-casting.

The edge functions of a triangle are evaluated in homogeneous coordinates (Olano and Greer, "Triangle Scan Conversion
Using 2D Homogeneous Coordinates", Graphics Hardware 1997), which is the intersection of the triangle with the ray of
each pixel: nothing has to be clipped, and neighbours that share an edge leave no gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Camera, Float32, Float64, Int32
from framework.rendering.rasterizer_kernels import bounding_spheres, draw_triangles, morton_codes, nearest


@dataclass(frozen=True)
class VisibilityBuffer:
    """What each pixel of a picture shows of a mesh."""

    triangle: Int32  # (H, W), NO_TRIANGLE = nothing is seen
    depth: Float32  # (H, W) m along z, 0 = nothing
    uv: Float32  # (H, W, 2) barycentric weights of the triangle's second and third vertex

    def nearest(self, triangles: Int32, labels: Int32) -> Int32:
        """(H, W) the label of the vertex nearest to what is seen, 0 where nothing is; triangles (F, 3), labels (V,).

        Nearest is the corner with the largest barycentric weight.
        """
        image = np.zeros(self.triangle.shape, np.int32)
        nearest(self.triangle, self.uv, triangles, labels, image)
        return image


class Rasterizer:
    """Draws a fixed triangle mesh. Safe to call from several threads."""

    def __init__(self, vertices: Float32, triangles: Int32) -> None:
        """vertices (V, 3) m, world; triangles (F, 3), seen from both sides."""
        self._vertices = np.ascontiguousarray(vertices, np.float32)
        # neighbours in space one after the other, so that they are in sight, and in the processor's caches, together
        self._order = np.argsort(morton_codes(self._vertices, triangles), kind="stable").astype(np.int32)
        self._triangles = triangles.astype(np.int32, copy=False)[self._order]
        self._spheres = bounding_spheres(self._vertices, self._triangles)

    def draw(self, camera: Camera, T_world_camera: Float64) -> VisibilityBuffer:
        """What the ray of each pixel meets first. Of surfaces at the same depth it is always the same one."""
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
