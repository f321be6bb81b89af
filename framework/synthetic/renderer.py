"""Renderer of furnished rooms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from framework.data import Camera, Float32, Float64, Int32, UInt8
from framework.rendering.rasterizer import Rasterizer
from framework.synthetic.lights import Lamp, bake
from framework.synthetic.ray_caster import RayCaster, image_rays, pixel_rays
from framework.synthetic.shading_kernels import (
    WHITE,
    LitSurfaces,
    Viewpoint,
    apply_tone_curve,
    find_edges,
    lose_readings,
    shade,
    smooth_edges,
)
from framework.synthetic.surfaces import Surfaces

# offsets (u, v) of the samples of an edge pixel from its center
EDGE_SAMPLES = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))  # px, on a rotated grid


@dataclass(frozen=True)
class Rendering:
    """Rendered images without noise."""

    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (H, W) m along z, 0 = no surface
    instance_ids: Int32  # (H, W), 0 = no instance
    incidence: Float32  # (H, W) in [0, 1], cosine of the angle between ray and surface normal
    unread: Float32  # (H, W) in [0, 1], fraction of depth readings lost on dark and shiny materials


class Renderer:
    """A thread-safe renderer of surfaces and lamps.

    The light is computed once for all vertices.
    """

    def __init__(self, surfaces: Surfaces, lamps: list[Lamp], irradiance: Float32 | None = None) -> None:
        """Prepare the surfaces and their light.

        Args:
            surfaces: The surfaces.
            lamps: The lamps.
            irradiance: The irradiance (V, 3) of the vertices, linear RGB; None = computed from the lamps.
        """
        self.surfaces = surfaces
        self.caster = RayCaster(surfaces.vertices, surfaces.triangles)
        corners = surfaces.vertices[surfaces.triangles].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        self._lit = LitSurfaces(
            texture=surfaces.texture,
            irradiance=bake(surfaces, self.caster, lamps) if irradiance is None else irradiance,
            triangles=surfaces.triangles,
            normals=normals.astype(np.float32),
            materials=surfaces.materials,
            parts=surfaces.parts,
            table=surfaces.material_table,
        )
        self._rasterizer = Rasterizer(surfaces.vertices, surfaces.triangles)

    def render(
        self,
        camera: Camera,
        T_world_camera: Float64,
        material_table: Float32 | None = None,
        brightness: float = 1.0,
    ) -> Rendering:
        """Render a view of the room.

        Args:
            camera: The camera.
            T_world_camera: The pose (4, 4).
            material_table: Other materials (M, 14) for the surfaces, with unchanged light; None = those of the room.
            brightness: The brightness of all lights, relative to the computed light.
        """
        surfaces = self._lit if material_table is None else self._lit._replace(table=material_table)
        buffer = self._rasterizer.draw(camera, T_world_camera)
        triangle, depth = buffer.triangle, buffer.depth
        T = np.ascontiguousarray(T_world_camera, np.float64)
        view = Viewpoint(T, *(float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy)))
        light, incidence = np.empty((*camera.shape, 3), np.float32), np.empty(camera.shape, np.float32)
        shade(surfaces, view, triangle, depth, buffer.uv, light, incidence)
        v, u = np.nonzero(find_edges(triangle, surfaces.parts, depth))
        if len(u):
            offsets = np.array(EDGE_SAMPLES)
            rays = pixel_rays(camera, T_world_camera, u[:, None] + offsets[:, 0], v[:, None] + offsets[:, 1])
            hits = self.caster.cast(rays)
            samples = offsets, hits.triangle, hits.distance, hits.uv
            smooth_edges(surfaces, view, u, v, *samples, triangle, depth, light)
        unread = np.empty(incidence.shape, np.float32)
        lose_readings(surfaces.materials, surfaces.table, triangle, incidence, unread)
        return Rendering(
            to_srgb(light * np.float32(brightness)), depth, _ids_of(self.surfaces, triangle), incidence, unread
        )

    def depth_and_ids(self, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Return the exact depth (H, W), m along z, and the instance ids (H, W) of a view.

        Both are 0 without a surface.
        """
        buffer = self._rasterizer.draw(camera, T_world_camera)
        return buffer.depth, _ids_of(self.surfaces, buffer.triangle)


def cast_ids(surfaces: Surfaces, caster: RayCaster, camera: Camera, T_world_camera: Float64) -> Int32:
    """Return the instance ids (H, W) of a view, computed by ray casting.

    For small images, this is faster than a Renderer.
    """
    return _ids_of(surfaces, caster.cast(image_rays(camera, T_world_camera)).triangle)


def _ids_of(surfaces: Surfaces, triangle: Int32) -> Int32:
    """Return the instance ids (H, W) of the triangles (H, W) in a view."""
    return np.append(surfaces.instance_ids, np.int32(0))[triangle]


def to_srgb(light: Float32) -> UInt8:
    """Convert linear light to 8-bit sRGB with the tone curve of Reinhard et al. 2002, eq. 4."""
    color = np.empty(light.shape, np.uint8)
    apply_tone_curve(light.reshape(-1), _tone_curve(), color.reshape(-1))
    return color


@lru_cache
def _tone_curve(entries: int = 8192) -> UInt8:
    x = np.linspace(0, WHITE, entries) * 1.25
    y = x * (1 + x / (1.25 * WHITE) ** 2) / (1 + x)
    y /= y[-1]
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).astype(np.uint8)
