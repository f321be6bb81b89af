"""Computation of the static light of a room, stored at the vertices.

The light consists of direct light from lamps and windows with soft shadows, and of three diffuse reflections. Surfaces
are Lambertian, as assumed by photometric tracking. All vertices use the same ray directions, which prevents noise
between neighbors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from framework.data import Float32, Float64, Int32
from framework.synthetic.paints import Color
from framework.synthetic.ray_caster import RayCaster
from framework.synthetic.shading_kernels import gather_light
from framework.synthetic.surfaces import Surfaces

GATHER_DIRECTIONS = 48  # number of rays per vertex for light from other surfaces
BOUNCES = 3  # number of diffuse bounces
LIFT = 4e-3  # m, height of the ray origins above the surface
CHUNK = 8192  # number of vertices per chunk, to limit memory
WALL_BRIGHTNESS = 0.60  # mean irradiance of floor, walls and ceiling after scaling; leaves headroom for bright areas


@dataclass(frozen=True)
class Lamp:
    """A light source, represented by sample points."""

    points: Float64  # (S, 3) m
    normals: Float64  # (S, 3) unit vectors in the direction of emission; zero vector = emission in all directions
    power: Color  # linear RGB, total power of the lamp in arbitrary units


def globe(center: Float64, radius: float, power: Color, samples: int = 16) -> Lamp:
    """Return a spherical lamp.

    Args:
        center: The center (3,), m.
        radius: The radius, m.
        power: The total power, linear RGB.
        samples: The number of sample points.
    """
    k = np.arange(samples) + 0.5  # on a Fibonacci sphere
    z, angle = 1 - 2 * k / samples, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    sphere = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return Lamp(center + radius * sphere, np.zeros((samples, 3)), power)


def rectangle(corner: Float64, along: Float64, up: Float64, normal: Float64, power: Color, side: int = 5) -> Lamp:
    """Return a rectangular lamp, such as a window.

    Args:
        corner: A corner (3,) of the rectangle, m.
        along: The first edge (3,) from the corner, m.
        up: The second edge (3,) from the corner, m.
        normal: The direction of emission (3,), a unit vector.
        power: The total power, linear RGB.
        side: The number of sample points along each edge.
    """
    f = (np.arange(side) + 0.5) / side
    s, t = np.meshgrid(f, f)
    points = corner + s.reshape(-1, 1) * along + t.reshape(-1, 1) * up
    return Lamp(points, np.tile(normal, (side * side, 1)), power)


def bake(surfaces: Surfaces, caster: RayCaster, lamps: list[Lamp]) -> Float32:
    """Compute the irradiance (V, 3), linear RGB, of the vertices.

    The result is scaled so that the mean on floor, walls and ceiling is WALL_BRIGHTNESS.

    Args:
        surfaces: The surfaces of the room.
        caster: The ray caster of the surfaces.
        lamps: The lamps.
    """
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
        bounced = gather_light(triangle, uv, surfaces.triangles, surfaces.materials, reflectance, total)
        total = (direct + bounced).astype(np.float32)
    shell = np.unique(surfaces.triangles[surfaces.instance_ids == 0])
    return np.asarray(total * (WALL_BRIGHTNESS / max(float(total[shell].mean()), 1e-9)), np.float32)


def _direct(origins: Float32, normals: Float32, caster: RayCaster, lamp: Lamp) -> Float64:
    to_lamp = lamp.points[None].astype(np.float32) - origins[:, None]
    square = np.maximum((to_lamp**2).sum(axis=-1), 0.04)  # limits the brightness of point samples closer than 20 cm
    direction = to_lamp / np.sqrt(square)[..., None]
    received = np.maximum(np.einsum("vsc,vc->vs", direction, normals), 0)
    sent = np.maximum(-np.einsum("vsc,sc->vs", direction, lamp.normals.astype(np.float32)), 0)
    sent[:, ~lamp.normals.any(axis=1)] = 0.25  # a globe emits equal power in all directions
    weight = received * sent / square
    vertex, sample = np.nonzero(weight > 0)
    blocked = caster.occluded(origins[vertex], lamp.points[sample].astype(np.float32))
    weight[vertex[blocked], sample[blocked]] = 0
    return np.asarray(weight.mean(axis=1)[:, None] * np.array(lamp.power))


def _gather(origins: Float32, normals: Float32, caster: RayCaster) -> tuple[Int32, Float32]:
    """Cast rays from all vertices in D directions and return the hit triangles and barycentric weights.

    The triangles (V, D) are -1 without a hit. The weights (V, D, 2) belong to the second and third vertex.
    """
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


def _cosine_directions(count: int) -> Float64:
    """Return cosine-distributed unit vectors (D, 3) around +z."""
    k = np.arange(count) + 0.5  # Malley's method
    r, angle = np.sqrt(k / count), np.pi * (1 + 5**0.5) * k
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.sqrt(1 - r * r)], axis=1)
