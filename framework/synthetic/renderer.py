"""Pictures of a lit room: colour, exact depth and instance ids."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from framework.data import Bool, Camera, Float32, Float64, Int32, UInt8
from framework.synthetic.lights import Lamp, bake
from framework.synthetic.ray_caster import NO_TRIANGLE, Hits, RayCaster, image_rays, pixel_rays
from framework.synthetic.surfaces import Surfaces
from framework.synthetic.textures import surface_color

Int64 = npt.NDArray[np.int64]

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
        depth, ids = _seen(hits.triangle, hits.distance, self.surfaces.instance_ids)
        light, incidence = self._shade(rays, hits, camera)
        self._smooth_edges(light, hits.triangle, depth, camera, T_world_camera)
        return Rendering(to_srgb(light), depth, ids, incidence)

    def depth_and_ids(self, camera: Camera, T_world_camera: Float64) -> tuple[Float32, Int32]:
        """Exact depth and instance ids only, (H, W) each."""
        return depth_and_ids(self.surfaces, self.caster, camera, T_world_camera)

    def _shade(self, rays: Float32, hits: Hits, camera: Camera) -> tuple[Float32, Float32]:
        """The light (A, B, 3) that hits (A, B) send back along their rays, and under which cosines (A, B) it leaves.

        Each hit is shaded by itself, so the split among threads changes nothing.
        """
        s = self.surfaces
        light = np.empty((*hits.triangle.shape, 3), np.float32)
        incidence = np.empty(hits.triangle.shape, np.float32)
        bounds = np.linspace(0, len(light), SHADING_THREADS + 1).astype(int)

        def shade(k: int) -> None:
            part = slice(bounds[k], bounds[k + 1])
            _shade_hits(
                rays[part],
                hits.triangle[part],
                hits.uv[part],
                hits.distance[part],
                hits.normal[part],
                1.0 / camera.fx,
                s.triangles,
                s.materials,
                s.material_table,
                s.texture,
                self.irradiance,
                light[part],
                incidence[part],
            )

        list(self._threads.map(shade, range(SHADING_THREADS)))
        return light, incidence

    def _smooth_edges(
        self, light: Float32, triangle: Int32, depth: Float32, camera: Camera, T_world_camera: Float64
    ) -> None:
        """Anti-aliasing: pixels at the border between two parts become the mean of several rays."""
        v, u = np.nonzero(_edges(triangle, self.surfaces.parts, depth))
        if not len(u):
            return
        offsets = np.array(EDGE_SAMPLES)
        rays = pixel_rays(camera, T_world_camera, u[:, None] + offsets[:, 0], v[:, None] + offsets[:, 1])
        samples, _ = self._shade(rays, self.caster.cast(rays), camera)
        _average(samples, v, u, light)


def depth_and_ids(
    surfaces: Surfaces, caster: RayCaster, camera: Camera, T_world_camera: Float64
) -> tuple[Float32, Int32]:
    """What a Renderer's method of this name gives, without the light that a Renderer begins with."""
    hits = caster.cast(image_rays(camera, T_world_camera))
    depth, ids = _seen(hits.triangle, hits.distance, surfaces.instance_ids)
    return depth, ids


# The kernels compute in float32, in this order: other code wrote pictures that these must equal to the last bit.


@njit(cache=True, nogil=True)
def _seen(triangle: Int32, distance: Float32, instance_ids: Int32) -> tuple[Float32, Int32]:
    """Depth and instance ids (H, W) of hits (H, W), both 0 where nothing was met."""
    depth, ids = np.empty(triangle.shape, np.float32), np.empty(triangle.shape, np.int32)
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            met = triangle[v, u] != NO_TRIANGLE
            depth[v, u] = distance[v, u] if met else np.float32(0)
            ids[v, u] = instance_ids[triangle[v, u]] if met else 0
    return depth, ids


@njit(cache=True, nogil=True)
def _edges(triangle: Int32, parts: Int32, depth: Float32) -> Bool:
    """The pixels (H, W) on either side of a border between two parts, or of a step of depth."""
    height, width = depth.shape
    edge = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            own = parts[triangle[v, u]] if triangle[v, u] != NO_TRIANGLE else -1
            largest = np.float32(EDGE_STEP) * depth[v, u]
            for y, x in ((v, u + 1), (v + 1, u)):
                if y == height or x == width:
                    continue
                other = parts[triangle[y, x]] if triangle[y, x] != NO_TRIANGLE else -1
                if own != other or abs(depth[v, u] - depth[y, x]) > largest:
                    edge[v, u] = edge[y, x] = True
    return edge


@njit(cache=True, nogil=True)
def _average(samples: Float32, v: Int64, u: Int64, light: Float32) -> None:
    """Writes to the pixels (N,) of `light` (H, W, 3) the means of their samples (N, S, 3), none whiter than white."""
    white, count = np.float32(WHITE), np.float32(samples.shape[1])
    for n in range(len(samples)):
        for channel in range(3):
            total = np.float32(0)
            for k in range(samples.shape[1]):
                total += min(samples[n, k, channel], white)
            light[v[n], u[n], channel] = total / count


@njit(cache=True, nogil=True)
def _shade_hits(
    rays: Float32,
    triangle: Int32,
    uv: Float32,
    distance: Float32,
    normal: Float32,
    pixel_angle: float,
    triangles: Int32,
    materials: Int32,
    table: Float32,
    texture: Float32,
    irradiance: Float32,
    light: Float32,
    incidence: Float32,
) -> None:
    """Writes the linear light (A, B, 3) that leaves each hit (A, B) along its ray, and the cosines (A, B)."""
    for row in range(triangle.shape[0]):
        for n in range(triangle.shape[1]):
            dx, dy, dz = rays[row, n, 3], rays[row, n, 4], rays[row, n, 5]
            along = dx * normal[row, n, 0] + dy * normal[row, n, 1] + dz * normal[row, n, 2]
            cosine = abs(along) / np.sqrt(dx * dx + dy * dy + dz * dz)
            incidence[row, n] = cosine
            f = triangle[row, n]
            if f == NO_TRIANGLE:
                light[row, n] = 0.0
                continue
            i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
            b, c = uv[row, n, 0], uv[row, n, 1]
            a = 1 - b - c
            x = a * texture[i, 0] + b * texture[j, 0] + c * texture[k, 0]
            y = a * texture[i, 1] + b * texture[j, 1] + c * texture[k, 1]
            z = a * texture[i, 2] + b * texture[j, 2] + c * texture[k, 2]
            material = table[materials[f]]
            # The footprint is an ellipse at grazing angles; its geometric mean loses the least of both axes.
            footprint = distance[row, n] * pixel_angle / np.sqrt(max(cosine, np.float32(0.05)))
            color = surface_color(material, x, y, z, footprint)
            for channel in range(3):
                received = a * irradiance[i, channel] + b * irradiance[j, channel] + c * irradiance[k, channel]
                light[row, n, channel] = color[channel] * (received + material[11])


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
