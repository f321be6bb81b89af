"""What a camera sees of a lit surface: its own colours, or those of its instances on a pale background."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from framework.data import Bool, Camera, Float32, Float64, Int32, UInt8
from framework.reports.surface import FrontSides, Hits, Surface

SUPERSAMPLING = 2  # rays per pixel in either direction
NOTHING = (229, 232, 236)  # where nothing was mapped: a shade off the paper, as mapped things may be white


class LitView:
    """The picture that `camera` at `T_world_camera` takes of a surface, before it is coloured."""

    def __init__(self, surface: Surface, camera: Camera, T_world_camera: Float64) -> None:
        sides = FrontSides(surface, T_world_camera[:3, 3])
        self._fine = sides.seen_by(camera.scaled(SUPERSAMPLING), T_world_camera[:3, :3])
        self.hits = self._fine.every(SUPERSAMPLING)  # of camera.shape
        normals = _normals_seen(self._fine, surface.vertex_normals(), T_world_camera)
        openness = sides.openness(self.hits, normals[::SUPERSAMPLING, ::SUPERSAMPLING])
        self._light = _lighting(normals, T_world_camera) * cv2.resize(openness, self._fine.depth.shape[::-1])

    def in_colors(self, colors: UInt8) -> UInt8:
        """(H, W, 3) RGB, the vertices' own colours (V, 3)."""
        return self._developed(self._fine.interpolated(colors.astype(np.float32)) * 1.08)

    def in_instances(self, colors: UInt8, ids: Int32, color_of: Mapping[int, UInt8]) -> UInt8:
        """(H, W, 3) RGB, each instance in its one colour.

        Args:
            colors: (V, 3) RGB of the vertices: their texture shows through.
            ids: (V,) instances of the vertices, 0 = none.
            color_of: RGB (3,) of each id.
        """
        instance_image = self._fine.nearest(ids)
        palette = np.zeros((max([0, *color_of]) + 1, 3), np.float32)
        for key, rgb in color_of.items():
            palette[key] = rgb
        gray = self._fine.interpolated(colors.astype(np.float32)).mean(axis=2, keepdims=True)
        background = 0.22 * gray + 178.0  # pale, so that the instances stand out
        painted = palette[instance_image] * (0.84 + 0.16 * gray / 140.0)  # some texture shows through
        labeled = np.where(instance_image[..., None] > 0, painted, background)
        labeled[_borders(instance_image)] *= 0.45
        return self._developed(labeled)

    def _developed(self, color: Float32) -> UInt8:
        """The lit picture on paper, scaled down to the camera's size."""
        lit = np.clip(color * self._light[..., None], 0, 255)
        lit = np.where(self._fine.seen[..., None], lit, np.array(NOTHING, np.float32)).astype(np.float32)
        return np.asarray(cv2.resize(lit, self.hits.depth.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def _normals_seen(hits: Hits, vertex_normals: Float32, T_world_camera: Float64) -> Float32:
    """(H, W, 3) smooth normals, turned towards the camera."""
    normals = hits.interpolated(vertex_normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    towards = T_world_camera[:3, 3].astype(np.float32) - hits.points_world
    away = (normals * towards).sum(axis=2, keepdims=True) < 0
    return np.asarray(np.where(away, -normals, normals), np.float32)


def _lighting(normals: Float32, T_world_camera: Float64) -> Float32:
    """(H, W) brightness: a soft lamp over the viewer's left shoulder."""
    lamp = T_world_camera[:3, :3] @ np.array([-0.45, -0.75, -0.6])
    lamp /= np.linalg.norm(lamp)
    return np.asarray(0.70 + 0.34 * np.clip(normals @ lamp.astype(np.float32), 0, 1), np.float32)


def _borders(ids: Int32) -> Bool:
    """(H, W) where an instance meets another one or the background."""
    edge = np.zeros(ids.shape, np.bool_)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge
