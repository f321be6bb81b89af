"""Light baked into the vertices: soft shadows of lamps and windows, and three diffuse bounces between surfaces.

The light is static and surfaces are Lambertian, so a point looks the same from everywhere: what photometric tracking
assumes. Vertices gather with one fixed set of directions, so that neighbours see alike and no grain appears.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from framework.data import Float32, Float64, Int32
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.surfaces import Surfaces

GATHER_DIRECTIONS = 48  # rays a vertex for light from other surfaces
BOUNCES = 3
LIFT = 4e-3  # m, rays start this far above the surface
CHUNK = 8192  # vertices at a time, bounds the memory for rays
WALL_BRIGHTNESS = 0.60  # mean irradiance of the room's shell after exposure: leaves room for bright spots


@dataclass(frozen=True)
class Lamp:
    """Sample points of one light source."""

    points: Float64  # (S, 3) m
    normals: Float64  # (S, 3) unit, 0 = shines to all sides
    power: tuple[float, float, float]  # linear RGB, for the whole lamp


def globe(center: Float64, radius: float, power: tuple[float, float, float], samples: int = 16) -> Lamp:
    """A lamp that shines to all sides."""
    return Lamp(center + radius * _fibonacci_sphere(samples), np.zeros((samples, 3)), power)


def rectangle(
    corner: Float64, along: Float64, up: Float64, normal: Float64, power: tuple[float, float, float], side: int = 5
) -> Lamp:
    """A window of which `along` and `up` are the edges."""
    f = (np.arange(side) + 0.5) / side
    s, t = np.meshgrid(f, f)
    points = corner + s.reshape(-1, 1) * along + t.reshape(-1, 1) * up
    return Lamp(points, np.tile(normal, (side * side, 1)), power)


def bake(surfaces: Surfaces, caster: RayCaster, lamps: list[Lamp]) -> Float32:
    """The irradiance (V, 3) of each vertex, exposed so that the room's shell has WALL_BRIGHTNESS on average."""
    origins = surfaces.vertices + np.float32(LIFT) * surfaces.normals
    direct = np.zeros((len(origins), 3))
    for begin in range(0, len(origins), CHUNK):
        part = slice(begin, begin + CHUNK)
        for lamp in lamps:
            direct[part] += _direct(origins[part], surfaces.normals[part], caster, lamp)
    triangle, uv = _gather(origins, surfaces.normals, caster)
    reflectance = surfaces.material_table[:, 1:7].reshape(-1, 2, 3).mean(axis=1)
    total = direct.astype(np.float32)
    for _ in range(BOUNCES):
        total = direct + _collect(triangle, uv, surfaces.triangles, surfaces.materials, reflectance, total)
        total = total.astype(np.float32)
    shell = np.unique(surfaces.triangles[surfaces.instance_ids == 0])
    return np.asarray(total * (WALL_BRIGHTNESS / max(float(total[shell].mean()), 1e-9)), np.float32)


def _direct(origins: Float32, normals: Float32, caster: RayCaster, lamp: Lamp) -> Float64:
    to_lamp = lamp.points[None].astype(np.float32) - origins[:, None]
    square = np.maximum((to_lamp**2).sum(axis=-1), 0.04)  # nearer than 20 cm a point sample would glare
    direction = to_lamp / np.sqrt(square)[..., None]
    received = np.maximum(np.einsum("vsc,vc->vs", direction, normals), 0)
    sent = np.maximum(-np.einsum("vsc,sc->vs", direction, lamp.normals.astype(np.float32)), 0)
    sent[:, ~lamp.normals.any(axis=1)] = 0.25  # a globe of the same power sends this much to each side
    weight = received * sent / square
    vertex, sample = np.nonzero(weight > 0)
    blocked = caster.occluded(origins[vertex], lamp.points[sample].astype(np.float32))
    weight[vertex[blocked], sample[blocked]] = 0
    return np.asarray(weight.mean(axis=1)[:, None] * np.array(lamp.power))


def _gather(origins: Float32, normals: Float32, caster: RayCaster) -> tuple[Int32, Float32]:
    """What each vertex sees: triangles (V, D) and barycentric weights (V, D, 2), -1 = nothing."""
    local = _cosine_directions(GATHER_DIRECTIONS)
    triangle = np.empty((len(origins), len(local)), np.int32)
    uv = np.empty((*triangle.shape, 2), np.float32)
    for begin in range(0, len(origins), CHUNK):
        part = slice(begin, begin + CHUNK)
        n = normals[part].astype(np.float64)
        helper = np.where(np.abs(n[:, 2:3]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
        aside = np.cross(helper, n)
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        basis = np.stack([aside, np.cross(n, aside), n], axis=1)
        rays = np.empty((len(n), len(local), 6), np.float32)
        rays[..., :3] = origins[part, None]
        rays[..., 3:] = np.einsum("dk,vkc->vdc", local, basis)
        hits = caster.cast(rays)
        triangle[part], uv[part] = hits.triangle, hits.uv
    return triangle, uv


@njit(cache=True, nogil=True)
def _collect(
    triangle: Int32, uv: Float32, triangles: Int32, materials: Int32, reflectance: Float32, irradiance: Float32
) -> Float32:
    """The mean of what the seen points reflect, (V, 3): with cosine-distributed rays that is the irradiance."""
    out = np.zeros((len(triangle), 3), np.float32)
    for v in range(len(triangle)):
        for d in range(triangle.shape[1]):
            f = triangle[v, d]
            if f < 0:
                continue
            b, c = uv[v, d, 0], uv[v, d, 1]
            for channel in range(3):
                light = (
                    (1 - b - c) * irradiance[triangles[f, 0], channel]
                    + b * irradiance[triangles[f, 1], channel]
                    + c * irradiance[triangles[f, 2], channel]
                )
                out[v, channel] += light * reflectance[materials[f], channel]
        out[v] /= triangle.shape[1]
    return out


def _fibonacci_sphere(count: int) -> Float64:
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _cosine_directions(count: int) -> Float64:
    """Directions (D, 3) about +z with density proportional to the cosine (Malley's method on a Fibonacci disc)."""
    k = np.arange(count) + 0.5
    r, angle = np.sqrt(k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.sqrt(1 - r * r)], axis=1)
