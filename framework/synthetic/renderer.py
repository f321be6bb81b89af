"""Pictures of a lit room: colour, exact depth and instance ids."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from framework.data import Camera, Float32, Float64, Int32, UInt8
from framework.synthetic.lights import Lamp, bake
from framework.synthetic.ray_caster import NO_TRIANGLE, RayCaster, image_rays, pixel_rays
from framework.synthetic.surfaces import Surfaces
from framework.synthetic.textures import surface_color

EDGE_SAMPLES = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))  # px, a rotated grid
EDGE_STEP = 0.04  # relative step of depth that counts as an edge
SHADING_THREADS = 2
WHITE = 2.2  # linear light that becomes full white: lamps and windows may burn out


@dataclass(frozen=True)
class Rendering:
    """What a perfect camera sees."""

    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (H, W) m along z, 0 = nothing
    instance_ids: Int32  # (H, W)
    incidence: Float32  # (H, W) cosine of the angle between ray and surface normal, in [0, 1]


class Renderer:
    """Renders `surfaces` under `lamps`, whose light is baked once. Safe to call from several threads."""

    def __init__(self, surfaces: Surfaces, lamps: list[Lamp], casting_threads: int = 0) -> None:
        self.surfaces = surfaces
        self.caster = RayCaster(surfaces.vertices, surfaces.triangles, casting_threads)
        self.irradiance = bake(surfaces, self.caster, lamps)
        # Not numba's own threads: their simplest layer may not be entered from two threads at once.
        self._threads = ThreadPoolExecutor(SHADING_THREADS, "shading")

    def render(self, camera: Camera, T_world_camera: Float64) -> Rendering:
        rays = image_rays(camera, T_world_camera)
        hits = self.caster.cast(rays)
        met = hits.triangle != NO_TRIANGLE
        depth = np.where(met, hits.distance, np.float32(0))
        direction = rays[..., 3:]
        incidence = np.abs(np.einsum("hwc,hwc->hw", direction, hits.normal))
        incidence /= np.sqrt(np.einsum("hwc,hwc->hw", direction, direction))
        light = self._shade(hits.triangle.ravel(), hits.uv.reshape(-1, 2), depth.ravel(), incidence.ravel(), camera)
        light = light.reshape(*camera.shape, 3)
        self._smooth_edges(light, hits.triangle, depth, camera, T_world_camera)
        ids = np.where(met, self.surfaces.instance_ids[hits.triangle], 0).astype(np.int32)
        return Rendering(to_srgb(light), depth, ids, incidence)

    def depth_and_ids(self, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Exact depth and instance ids only, (H, W) each."""
        return depth_and_ids(self.surfaces, self.caster, camera, T_world_camera)

    def _shade(self, triangle: Int32, uv: Float32, depth: Float32, incidence: Float32, camera: Camera) -> Float32:
        """The light (N, 3) of N hits. Each hit is shaded by itself, so the split among threads changes nothing."""
        s = self.surfaces
        light = np.empty((len(triangle), 3), np.float32)
        bounds = np.linspace(0, len(triangle), SHADING_THREADS + 1).astype(int)

        def shade(k: int) -> None:
            part = slice(bounds[k], bounds[k + 1])
            _shade_hits(
                triangle[part],
                uv[part],
                depth[part],
                incidence[part],
                1.0 / camera.fx,
                s.triangles,
                s.materials,
                s.material_table,
                s.texture,
                self.irradiance,
                light[part],
            )

        list(self._threads.map(shade, range(SHADING_THREADS)))
        return light

    def _smooth_edges(
        self, light: Float32, triangle: Int32, depth: Float32, camera: Camera, T_world_camera: Float64
    ) -> None:
        """Anti-aliasing: pixels at the border between two parts become the mean of several rays."""
        part = np.where(triangle == NO_TRIANGLE, -1, self.surfaces.parts[triangle])
        edge = np.zeros(depth.shape, np.bool_)
        for axis in (0, 1):
            near, far = [slice(None)] * 2, [slice(None)] * 2
            near[axis], far[axis] = slice(None, -1), slice(1, None)
            a, b = tuple(near), tuple(far)
            step = (part[a] != part[b]) | (np.abs(depth[a] - depth[b]) > EDGE_STEP * depth[a])
            edge[a] |= step
            edge[b] |= step
        v, u = np.nonzero(edge)
        if not len(u):
            return
        offsets = np.array(EDGE_SAMPLES)
        rays = pixel_rays(camera, T_world_camera, u[:, None] + offsets[:, 0], v[:, None] + offsets[:, 1]).reshape(-1, 6)
        hits = self.caster.cast(rays)
        direction = rays[:, 3:]
        incidence = np.abs(np.einsum("nc,nc->n", direction, hits.normal)) / np.linalg.norm(direction, axis=1)
        reach = np.where(hits.triangle == NO_TRIANGLE, np.float32(0), hits.distance)
        samples = self._shade(hits.triangle, hits.uv, reach, incidence, camera).reshape(-1, len(offsets), 3)
        light[v, u] = np.minimum(samples, WHITE).mean(axis=1)


def depth_and_ids(
    surfaces: Surfaces, caster: RayCaster, camera: Camera, T_world_camera: Float64
) -> tuple[Float32, Int32]:
    """What a Renderer's method of this name gives, without the light that a Renderer begins with."""
    hits = caster.cast(image_rays(camera, T_world_camera))
    met = hits.triangle != NO_TRIANGLE
    depth = np.where(met, hits.distance, np.float32(0))
    return depth, np.where(met, surfaces.instance_ids[hits.triangle], 0).astype(np.int32)


@njit(cache=True, nogil=True)
def _shade_hits(
    triangle: Int32,
    uv: Float32,
    depth: Float32,
    incidence: Float32,
    pixel_angle: float,
    triangles: Int32,
    materials: Int32,
    table: Float32,
    texture: Float32,
    irradiance: Float32,
    out: Float32,
) -> None:
    """Writes the linear light (N, 3) that leaves each hit towards the camera to `out`."""
    for n in range(len(triangle)):
        f = triangle[n]
        if f < 0:
            out[n] = 0.0
            continue
        i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        b, c = uv[n, 0], uv[n, 1]
        a = 1 - b - c
        x = a * texture[i, 0] + b * texture[j, 0] + c * texture[k, 0]
        y = a * texture[i, 1] + b * texture[j, 1] + c * texture[k, 1]
        z = a * texture[i, 2] + b * texture[j, 2] + c * texture[k, 2]
        row = table[materials[f]]
        # The footprint is an ellipse at grazing angles; its geometric mean loses the least of both axes.
        footprint = depth[n] * pixel_angle / np.sqrt(max(incidence[n], np.float32(0.05)))
        color = surface_color(row, x, y, z, footprint)
        for channel in range(3):
            light = a * irradiance[i, channel] + b * irradiance[j, channel] + c * irradiance[k, channel]
            out[n, channel] = color[channel] * (light + row[11])


def to_srgb(light: Float32) -> UInt8:
    """8-bit sRGB of linear light, by Reinhard's curve with a white point (Reinhard et al. 2002, eq. 4)."""
    curve = _tone_curve()
    index = np.clip(light, 0, WHITE) * np.float32((len(curve) - 1) / WHITE)
    return np.asarray(curve[(index + np.float32(0.5)).astype(np.int32)])


def _tone_curve(entries: int = 8192) -> UInt8:
    x = np.linspace(0, WHITE, entries) * 1.25
    y = x * (1 + x / (1.25 * WHITE) ** 2) / (1 + x)
    y /= y[-1]
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.round(255 * srgb).astype(np.uint8)
