"""Lit images of a surface in its own colors or in instance colors."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from framework.data import Camera, Float32, Float64, Int32, UInt8
from framework.rendering.ambient_occlusion import openness
from framework.rendering.lit_view_kernels import light_up, paint
from framework.rendering.surface import FrontSides, Surface

SUPERSAMPLING = 2  # number of samples per pixel in each direction
NOTHING = (229, 232, 236)  # RGB of empty pixels; not white, because surfaces may be white


class LitView:
    """View of a surface with precomputed lighting.

    The methods return images of this view in different colors.
    """

    def __init__(self, surface: Surface, camera: Camera, T_world_camera: Float64) -> None:
        R_world_camera = T_world_camera[:3, :3]
        sides = FrontSides(surface, T_world_camera[:3, 3])
        self._fine = sides.seen_by(camera.scaled(SUPERSAMPLING), R_world_camera)
        self.hits = self._fine.subsampled(SUPERSAMPLING)  # at the resolution of `camera`
        normals = self._fine.interpolated(surface.vertex_normals)
        self._light = np.empty(self._fine.depth.shape, np.float32)
        light_up(normals, np.ascontiguousarray(R_world_camera), self._fine.camera.K, self._light)
        coarse = np.ascontiguousarray(normals[::SUPERSAMPLING, ::SUPERSAMPLING])
        ambient = openness(self.hits.camera, self.hits.depth, coarse)
        self._light *= cv2.resize(ambient, self._light.shape[::-1])

    def in_colors(self, colors: UInt8) -> UInt8:
        """Return the lit image (H, W, 3), RGB, in the given colors (V, 3) of the vertices."""
        return self._developed(self._fine.interpolated(colors * np.float32(1.08)))

    def in_instances(self, colors: UInt8, ids: Int32, color_of: Mapping[int, UInt8]) -> UInt8:
        """Return the lit image (H, W, 3), RGB, with one color per instance.

        Args:
            colors: The colors (V, 3) of the vertices, RGB. Their brightness remains visible.
            ids: The instance (V,) of each vertex, 0 = none.
            color_of: The color (3,) of each instance by id, RGB.
        """
        palette = np.zeros((max([0, *color_of]) + 1, 3), np.float32)
        for key, rgb in color_of.items():
            palette[key] = rgb
        gray = self._fine.interpolated(colors.mean(axis=1, keepdims=True, dtype=np.float32))[..., 0]
        painted = np.empty((*gray.shape, 3), np.float32)
        paint(self._fine.nearest(ids), gray, palette, painted)
        return self._developed(painted)

    def _developed(self, color: Float32) -> UInt8:
        """Return the lit image (H, W, 3), RGB, at the resolution of the camera.

        `color` is the unlit image at the supersampled resolution, modified in place.
        """
        np.clip(color * self._light[..., None], 0, 255, out=color)
        color[self._fine.depth <= 0] = NOTHING
        return np.asarray(cv2.resize(color, self.hits.depth.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
