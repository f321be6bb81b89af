"""What a camera sees of a lit surface: its own colours, or those of its instances on a pale background."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, Int32, UInt8
from framework.rendering.ambient_occlusion import openness
from framework.rendering.surface import FrontSides, Surface

SUPERSAMPLING = 2  # rays per pixel in either direction
NOTHING = (229, 232, 236)  # where nothing was mapped: a shade off the paper, as mapped things may be white
TO_LAMP = np.array([-0.45, -0.75, -0.6])  # in the camera's coordinates: over the viewer's left shoulder
LAMP = TO_LAMP / np.linalg.norm(TO_LAMP)
AMBIENT, DIFFUSE = 0.70, 0.34  # light from around and from the lamp, which is soft


class LitView:
    """The picture that `camera` at `T_world_camera` takes of a surface, before it is coloured."""

    def __init__(self, surface: Surface, camera: Camera, T_world_camera: Float64) -> None:
        R_world_camera = T_world_camera[:3, :3]
        sides = FrontSides(surface, T_world_camera[:3, 3])
        self._fine = sides.seen_by(camera.scaled(SUPERSAMPLING), R_world_camera)
        self.hits = self._fine.subsampled(SUPERSAMPLING)  # of camera.shape
        normals = self._fine.interpolated(surface.vertex_normals)
        self._light = np.empty(self._fine.depth.shape, np.float32)
        _light_up(normals, np.ascontiguousarray(R_world_camera), self._fine.camera.K, self._light)
        coarse = np.ascontiguousarray(normals[::SUPERSAMPLING, ::SUPERSAMPLING])
        ambient = openness(self.hits.camera, self.hits.depth, coarse)
        self._light *= cv2.resize(ambient, self._light.shape[::-1])

    def in_colors(self, colors: UInt8) -> UInt8:
        """(H, W, 3) RGB, the vertices' own colours (V, 3)."""
        return self._developed(self._fine.interpolated(colors * np.float32(1.08)))

    def in_instances(self, colors: UInt8, ids: Int32, color_of: Mapping[int, UInt8]) -> UInt8:
        """(H, W, 3) RGB, each instance in its one colour.

        Args:
            colors: (V, 3) RGB of the vertices: their texture shows through.
            ids: (V,) instances of the vertices, 0 = none.
            color_of: RGB (3,) of each id.
        """
        palette = np.zeros((max([0, *color_of]) + 1, 3), np.float32)
        for key, rgb in color_of.items():
            palette[key] = rgb
        gray = self._fine.interpolated(colors.mean(axis=1, keepdims=True, dtype=np.float32))[..., 0]
        painted = np.empty((*gray.shape, 3), np.float32)
        _paint(self._fine.nearest(ids), gray, palette, painted)
        return self._developed(painted)

    def _developed(self, color: Float32) -> UInt8:
        """The lit picture on paper, scaled down to the camera's size; `color` is used up."""
        np.clip(color * self._light[..., None], 0, 255, out=color)
        color[self._fine.depth <= 0] = NOTHING
        return np.asarray(cv2.resize(color, self.hits.depth.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)


@njit(cache=True, nogil=True)
def _light_up(normals: Float32, R_world_camera: Float64, K: Float64, light: Float32) -> None:
    """Writes the brightness (H, W), and turns the normals (H, W, 3): to the camera, of unit length, in its axes."""
    R = R_world_camera
    for v in range(normals.shape[0]):
        y = (v - K[1, 2]) / K[1, 1]
        for u in range(normals.shape[1]):
            n = normals[v, u]
            nx = R[0, 0] * n[0] + R[1, 0] * n[1] + R[2, 0] * n[2]
            ny = R[0, 1] * n[0] + R[1, 1] * n[1] + R[2, 1] * n[2]
            nz = R[0, 2] * n[0] + R[1, 2] * n[1] + R[2, 2] * n[2]
            away = (u - K[0, 2]) / K[0, 0] * nx + y * ny + nz > 0
            scale = (-1 if away else 1) / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            n[0], n[1], n[2] = scale * nx, scale * ny, scale * nz
            light[v, u] = AMBIENT + DIFFUSE * max(n[0] * LAMP[0] + n[1] * LAMP[1] + n[2] * LAMP[2], 0.0)


@njit(cache=True, nogil=True)
def _paint(ids: Int32, gray: Float32, palette: Float32, painted: Float32) -> None:
    """Writes the colour (H, W, 3) of each pixel's instance, before it is lit; some texture shows through."""
    height, width = ids.shape
    for v in range(height):
        for u in range(width):
            instance = ids[v, u]
            border = (
                (u > 0 and ids[v, u - 1] != instance)
                or (u < width - 1 and ids[v, u + 1] != instance)
                or (v > 0 and ids[v - 1, u] != instance)
                or (v < height - 1 and ids[v + 1, u] != instance)
            )
            dim = np.float32(0.45 if border else 1)  # where an instance meets another one or the background
            background = np.float32(0.22) * gray[v, u] + np.float32(178)  # pale, so that the instances stand out
            texture = np.float32(0.84) + np.float32(0.16 / 140) * gray[v, u]
            for k in range(3):
                painted[v, u, k] = dim * (palette[instance, k] * texture if instance > 0 else background)
