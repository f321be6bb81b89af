"""The light that leaves each point of a room towards a camera, with smooth edges between its parts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from framework.data import Bool, Camera, Float32, Float64, Int32, Int64
from framework.rendering.rasterizer import VisibilityBuffer
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic.ray_caster import RayCaster, pixel_rays
from framework.synthetic.surfaces import Surfaces
from framework.synthetic.textures import DARK, SHINY, surface_color

EDGE_SAMPLES = ((-0.375, 0.125), (-0.125, -0.375), (0.125, 0.375), (0.375, -0.125))  # px, a rotated grid
EDGE_STEP = 0.04  # relative step of depth that counts as an edge
WHITE = 2.2  # linear light that becomes full white: lamps and windows may burn out


GLANCED_OFF = np.float32(np.deg2rad(60.0))  # rad, of incidence, from which a mirror sends the projector's light away
GRAZING = np.float32(0.05)  # the least cosine that a pixel's footprint is computed with


class LitSurfaces(NamedTuple):
    """What the kernels read of a room."""

    texture: Float32  # (V, 3) m
    irradiance: Float32  # (V, 3) linear RGB
    triangles: Int32  # (F, 3)
    normals: Float32  # (F, 3) unit, towards no particular side
    materials: Int32  # (F,) row of the table
    parts: Int32  # (F,)
    table: Float32  # (M, 14), see textures.material_table


class Viewpoint(NamedTuple):
    """From where the kernels look."""

    T_world_camera: Float64
    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def of(cls, camera: Camera, T_world_camera: Float64) -> Viewpoint:
        T = np.ascontiguousarray(T_world_camera, np.float64)
        return cls(T, float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


def lit(surfaces: Surfaces, irradiance: Float32) -> LitSurfaces:
    """The surfaces under this light (V, 3)."""
    corners = surfaces.vertices[surfaces.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return LitSurfaces(
        texture=surfaces.texture,
        irradiance=irradiance,
        triangles=surfaces.triangles,
        normals=normals.astype(np.float32),
        materials=surfaces.materials,
        parts=surfaces.parts,
        table=surfaces.material_table,
    )


def shade(
    surfaces: LitSurfaces, caster: RayCaster, buffer: VisibilityBuffer, camera: Camera, T_world_camera: Float64
) -> tuple[Float32, Float32]:
    """The light (H, W, 3) of a picture, and under which cosines (H, W) to their normals surfaces are seen.

    Pixels at the border between two parts become the mean of several rays of `caster`.
    """
    view = Viewpoint.of(camera, T_world_camera)
    light, incidence = np.empty((*camera.shape, 3), np.float32), np.empty(camera.shape, np.float32)
    _shade(surfaces, view, buffer.triangle, buffer.depth, buffer.uv, light, incidence)
    v, u = np.nonzero(edges(buffer, surfaces.parts))
    if len(u):
        offsets = np.array(EDGE_SAMPLES)
        rays = pixel_rays(camera, T_world_camera, u[:, None] + offsets[:, 0], v[:, None] + offsets[:, 1])
        hits = caster.cast(rays)
        _smooth(
            surfaces, view, u, v, offsets, hits.triangle, hits.distance, hits.uv, buffer.triangle, buffer.depth, light
        )
    return light, incidence


def unread(surfaces: LitSurfaces, buffer: VisibilityBuffer, incidence: Float32) -> Float32:
    """The share (H, W) of a structured-light camera's readings that what is seen swallows or mirrors away."""
    lost = np.empty(incidence.shape, np.float32)
    _unread(surfaces.materials, surfaces.table, buffer.triangle, incidence, lost)
    return lost


def edges(buffer: VisibilityBuffer, parts: Int32) -> Bool:
    """The pixels (H, W) on either side of a border between two parts, or of a step of depth."""
    return np.asarray(_edges(buffer.triangle, parts, buffer.depth), np.bool_)


@njit(cache=True, nogil=True)
def _shade(
    s: LitSurfaces, view: Viewpoint, triangle: Int32, depth: Float32, uv: Float32, light: Float32, incidence: Float32
) -> None:
    """Writes the linear light (H, W, 3) that each pixel receives, and the cosines (H, W); black where nothing is."""
    texture, irradiance, triangles, normals, materials, _, table = s
    fx = np.float32(view.fx)
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            if f == NO_TRIANGLE:
                light[v, u], incidence[v, u] = 0, 0
                continue
            cosine = _cosine(view, normals, f, u, v)
            red, green, blue = _light_of(
                texture, irradiance, triangles, materials, table, f, uv[v, u, 0], uv[v, u, 1], depth[v, u] / fx, cosine
            )
            light[v, u, 0], light[v, u, 1], light[v, u, 2], incidence[v, u] = red, green, blue, cosine


@njit(cache=True, nogil=True)
def _unread(materials: Int32, table: Float32, triangle: Int32, incidence: Float32, lost: Float32) -> None:
    """Writes the share (H, W) lost: `dark` of all, and of the rest `shiny` times how far the surface is turned away."""
    one = np.float32(1)
    mirrored_away = one - np.cos(GLANCED_OFF)
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            lost[v, u] = 0
            if f == NO_TRIANGLE:
                continue
            dark, shiny = table[materials[f], DARK], table[materials[f], SHINY]
            turned = min((one - incidence[v, u]) / mirrored_away, one)
            lost[v, u] = dark + (one - dark) * shiny * turned


@njit(cache=True, nogil=True, inline="always")
def _cosine(view, normals, f, u, v):  # type: ignore[no-untyped-def]
    """Of the angle between the ray through image point u, v (px) and the normal of triangle f."""
    T, x, y = view.T_world_camera, (u - view.cx) / view.fx, (v - view.cy) / view.fy
    along = 0.0
    for axis in range(3):
        along += (T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]) * normals[f, axis]
    return min(abs(along) / np.sqrt(x * x + y * y + 1), 1.0)


@njit(cache=True, nogil=True, inline="always")
def _light_of(texture, irradiance, triangles, materials, table, f, b, c, pixel, cosine):  # type: ignore[no-untyped-def]
    """RGB that leaves the point of triangle f with these barycentric weights; a pixel there is `pixel` m wide."""
    i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
    a = np.float32(1) - b - c
    # The footprint is an ellipse at grazing angles; its geometric mean loses the least of both axes.
    footprint = pixel / np.sqrt(max(cosine, GRAZING))
    material = table[materials[f]]
    red, green, blue = surface_color(
        material,
        a * texture[i, 0] + b * texture[j, 0] + c * texture[k, 0],
        a * texture[i, 1] + b * texture[j, 1] + c * texture[k, 1],
        a * texture[i, 2] + b * texture[j, 2] + c * texture[k, 2],
        footprint,
    )
    emission = material[11]
    return (
        red * (a * irradiance[i, 0] + b * irradiance[j, 0] + c * irradiance[k, 0] + emission),
        green * (a * irradiance[i, 1] + b * irradiance[j, 1] + c * irradiance[k, 1] + emission),
        blue * (a * irradiance[i, 2] + b * irradiance[j, 2] + c * irradiance[k, 2] + emission),
    )


@njit(cache=True, nogil=True)
def _edges(triangle: Int32, parts: Int32, depth: Float32) -> Bool:
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
def _smooth(
    s: LitSurfaces,
    view: Viewpoint,
    u: Int64,
    v: Int64,
    offsets: Float64,
    triangle: Int32,
    distance: Float32,
    uv: Float32,
    own: Int32,
    depth: Float32,
    light: Float32,
) -> None:
    """Writes to the pixels u, v (N,) of `light` (H, W, 3) the mean of their samples, none whiter than white.

    triangle, distance (N, S) and uv (N, S, 2): what the samples meet, `offsets` (S, 2) px from the pixel's centre. One
    that meets the pixel's `own` part, about as far away as its centre, is as light as that. own (H, W), depth (H, W).
    """
    texture, irradiance, triangles, normals, materials, parts, table = s
    white, fx = np.float32(WHITE), np.float32(view.fx)
    for n in range(len(u)):
        y, x = v[n], u[n]
        red, green, blue = np.float32(0), np.float32(0), np.float32(0)
        for k in range(len(offsets)):
            f, z = triangle[n, k], distance[n, k]
            if f == NO_TRIANGLE:
                continue
            step = abs(z - depth[y, x])
            if own[y, x] != NO_TRIANGLE and parts[f] == parts[own[y, x]] and step <= EDGE_STEP * depth[y, x]:
                r, g, b = light[y, x, 0], light[y, x, 1], light[y, x, 2]
            else:
                cosine = _cosine(view, normals, f, x + offsets[k, 0], y + offsets[k, 1])
                r, g, b = _light_of(
                    texture, irradiance, triangles, materials, table, f, uv[n, k, 0], uv[n, k, 1], z / fx, cosine
                )
            red, green, blue = red + min(r, white), green + min(g, white), blue + min(b, white)
        light[y, x, 0], light[y, x, 1], light[y, x, 2] = red / len(offsets), green / len(offsets), blue / len(offsets)
