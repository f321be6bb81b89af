"""Pictures of a lit room: colour, exact depth and instance ids."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, Int32, UInt8
from framework.rendering.rasterizer import Rasterizer, VisibilityBuffer
from framework.synthetic.lights import Lamp, bake
from framework.synthetic.ray_caster import RayCaster, image_rays
from framework.synthetic.shading import WHITE, lit, shade, unread
from framework.synthetic.surfaces import Surfaces


@dataclass(frozen=True)
class Rendering:
    """What a perfect camera sees."""

    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (H, W) m along z, 0 = nothing
    instance_ids: Int32  # (H, W)
    incidence: Float32  # (H, W) cosine of the angle between ray and surface normal, in [0, 1]
    unread: Float32  # (H, W) in [0, 1], share of a depth camera's readings lost to dark and shiny materials


class Renderer:
    """Renders `surfaces` under `lamps`, whose light is baked once. Safe to call from several threads."""

    def __init__(self, surfaces: Surfaces, lamps: list[Lamp]) -> None:
        self.surfaces = surfaces
        self.caster = RayCaster(surfaces.vertices, surfaces.triangles)
        self._lit = lit(surfaces, bake(surfaces, self.caster, lamps))
        self._rasterizer = Rasterizer(surfaces.vertices, surfaces.triangles)

    def render(self, camera: Camera, T_world_camera: Float64, material_table: Float32 | None = None) -> Rendering:
        """The picture of the room, or of one with the same light and other materials (see textures.material_table)."""
        surfaces = self._lit if material_table is None else self._lit._replace(table=material_table)
        buffer = self._rasterizer.draw(camera, T_world_camera)
        light, incidence = shade(surfaces, self.caster, buffer, camera, T_world_camera)
        lost = unread(surfaces, buffer, incidence)
        return Rendering(to_srgb(light), buffer.depth, self._ids(buffer), incidence, lost)

    def depth_and_ids(self, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Exact depth and instance ids only, (H, W) each."""
        buffer = self._rasterizer.draw(camera, T_world_camera)
        return buffer.depth, self._ids(buffer)

    def _ids(self, buffer: VisibilityBuffer) -> Int32:
        return _of_triangles(self.surfaces.instance_ids, buffer.triangle)


def ids_met(surfaces: Surfaces, caster: RayCaster, camera: Camera, T_world_camera: Float64) -> Int32:
    """The instance ids (H, W) by ray-casting: for small pictures cheaper than a Renderer, and without its light."""
    return _of_triangles(surfaces.instance_ids, caster.cast(image_rays(camera, T_world_camera)).triangle)


def _of_triangles(instance_ids: Int32, triangle: Int32) -> Int32:
    """The instances (H, W) that triangles (H, W) belong to, 0 where nothing was met: NO_TRIANGLE is -1."""
    return np.append(instance_ids, np.int32(0))[triangle]


def to_srgb(light: Float32) -> UInt8:
    """8-bit sRGB of linear light, by Reinhard's curve with a white point (Reinhard et al. 2002, eq. 4)."""
    color = np.empty(light.shape, np.uint8)
    _look_up(light.reshape(-1), _tone_curve(), color.reshape(-1))
    return color


@njit(cache=True, nogil=True)
def _look_up(light: Float32, curve: UInt8, color: UInt8) -> None:
    """Writes for each light (N,) from 0 to WHITE, or beyond, the nearest entry of the curve."""
    white, entries = np.float32(WHITE), np.float32((len(curve) - 1) / WHITE)
    for n in range(len(light)):
        index = min(max(light[n], np.float32(0)), white) * entries
        color[n] = curve[np.int32(index + np.float32(0.5))]


@lru_cache
def _tone_curve(entries: int = 8192) -> UInt8:
    x = np.linspace(0, WHITE, entries) * 1.25
    y = x * (1 + x / (1.25 * WHITE) ** 2) / (1 + x)
    y /= y[-1]
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).astype(np.uint8)
