"""Numba kernels of lights.py and renderer.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from framework.data import Bool, Float32, Float64, Int32, Int64, UInt8
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic.paints import DARK, EMISSION, SHINY
from framework.synthetic.texture_kernels import surface_color

EDGE_STEP = 0.04  # minimum depth step at an edge, relative to the depth
WHITE = 2.2  # linear light that is mapped to sRGB white; lamps and windows may saturate
GLANCED_OFF = np.float32(np.deg2rad(60.0))  # rad, angle of incidence from which a mirror loses all readings
GRAZING = np.float32(0.05)  # lower limit of the cosine of the angle of incidence for the footprint of a pixel


class LitSurfaces(NamedTuple):
    """Triangles of a room with baked light."""

    texture: Float32  # (V, 3) m, texture coordinates
    irradiance: Float32  # (V, 3) linear RGB
    triangles: Int32  # (F, 3) vertex indices
    normals: Float32  # (F, 3) unit vectors that point to either side of a triangle
    materials: Int32  # (F,) rows of the table
    parts: Int32  # (F,) index of each triangle's part
    table: Float32  # (M, 14), see paints.material_table


class Viewpoint(NamedTuple):
    """Pose and intrinsics (px) of a camera."""

    T_world_camera: Float64
    fx: float
    fy: float
    cx: float
    cy: float


@njit(cache=True, nogil=True)
def gather_light(
    triangle: Int32, uv: Float32, triangles: Int32, materials: Int32, reflectance: Float32, irradiance: Float32
) -> Float32:
    """Return the mean light (V, 3), linear RGB, that the points visible from each vertex reflect.

    For cosine-distributed directions, this is the irradiance of the vertex.

    Args:
        triangle: (V, D) triangle visible from each vertex in D directions, -1 = none.
        uv: (V, D, 2) barycentric weights of the second and third vertex.
        triangles: (F, 3) vertex indices.
        materials: (F,) rows of `reflectance`.
        reflectance: (M, 3) linear RGB.
        irradiance: (V, 3) linear RGB.
    """
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


@njit(cache=True, nogil=True)
def shade(
    s: LitSurfaces, view: Viewpoint, triangle: Int32, depth: Float32, uv: Float32, light: Float32, incidence: Float32
) -> None:
    """Write the light and the cosine of the angle of incidence of each pixel; both are 0 without a surface.

    Args:
        s: Surfaces in view.
        view: Camera.
        triangle: (H, W) visible triangle, NO_TRIANGLE = none.
        depth: (H, W) m along z.
        uv: (H, W, 2) barycentric weights of the second and third vertex.
        light: (H, W, 3) output, linear RGB.
        incidence: (H, W) output, cosine of the angle of incidence.
    """
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
def lose_readings(materials: Int32, table: Float32, triangle: Int32, incidence: Float32, lost: Float32) -> None:
    """Write the fraction of lost depth readings to `lost`: dark + (1 - dark) * shiny * slant.

    The slant of a surface is 0 at perpendicular incidence and 1 from an angle of incidence of GLANCED_OFF on.

    Args:
        materials: (F,) rows of `table`.
        table: (M, 14) see paints.material_table.
        triangle: (H, W) visible triangle, NO_TRIANGLE = none.
        incidence: (H, W) cosine of the angle of incidence.
        lost: (H, W) output in [0, 1].
    """
    one = np.float32(1)
    mirrored_away = one - np.cos(GLANCED_OFF)
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            lost[v, u] = 0
            if f == NO_TRIANGLE:
                continue
            dark, shiny = table[materials[f], DARK], table[materials[f], SHINY]
            slant = min((one - incidence[v, u]) / mirrored_away, one)
            lost[v, u] = dark + (one - dark) * shiny * slant


@njit(cache=True, nogil=True, inline="always")
def _cosine(view, normals, f, u, v):
    """Return the cosine of the angle between the ray through image point u, v (px) and the normal of triangle f."""
    T, x, y = view.T_world_camera, (u - view.cx) / view.fx, (v - view.cy) / view.fy
    along = 0.0
    for axis in range(3):
        along += (T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]) * normals[f, axis]
    return min(abs(along) / np.sqrt(x * x + y * y + 1), 1.0)


@njit(cache=True, nogil=True, inline="always")
def _light_of(texture, irradiance, triangles, materials, table, f, b, c, pixel, cosine):
    """Return the emitted and reflected light, linear RGB, at a point of triangle f.

    b and c are the barycentric weights of the second and third vertex. `pixel` is the width of a pixel at the point, m.
    `cosine` is the cosine of the angle of incidence.
    """
    i, j, k = triangles[f, 0], triangles[f, 1], triangles[f, 2]
    a = np.float32(1) - b - c
    # The footprint is an ellipse at grazing angles; the geometric mean of its axes is a compromise between them.
    footprint = pixel / np.sqrt(max(cosine, GRAZING))
    material = table[materials[f]]
    red, green, blue = surface_color(
        material,
        a * texture[i, 0] + b * texture[j, 0] + c * texture[k, 0],
        a * texture[i, 1] + b * texture[j, 1] + c * texture[k, 1],
        a * texture[i, 2] + b * texture[j, 2] + c * texture[k, 2],
        footprint,
    )
    emission = material[EMISSION]
    return (
        red * (a * irradiance[i, 0] + b * irradiance[j, 0] + c * irradiance[k, 0] + emission),
        green * (a * irradiance[i, 1] + b * irradiance[j, 1] + c * irradiance[k, 1] + emission),
        blue * (a * irradiance[i, 2] + b * irradiance[j, 2] + c * irradiance[k, 2] + emission),
    )


@njit(cache=True, nogil=True)
def find_edges(triangle: Int32, parts: Int32, depth: Float32) -> Bool:
    """Return the mask (H, W) of the pixels on both sides of a border between two parts or of a depth step.

    Args:
        triangle: (H, W) visible triangle, NO_TRIANGLE = none.
        parts: (F,) index of each triangle's part.
        depth: (H, W) m along z.
    """
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
def smooth_edges(
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
    """Write the mean light of several samples to the N pixels u, v of `light`; each sample is clipped to WHITE.

    A sample gets the light of the pixel center if it is on the same part and at a similar depth.

    Args:
        s: Surfaces in view.
        view: Camera.
        u: (N,) columns of the pixels.
        v: (N,) rows of the pixels.
        offsets: (S, 2) px, offsets u, v of the samples from the pixel center.
        triangle: (N, S) visible triangle of each sample, NO_TRIANGLE = none.
        distance: (N, S) m along z, depth of each sample.
        uv: (N, S, 2) barycentric weights of the second and third vertex.
        own: (H, W) visible triangle at the pixel center, NO_TRIANGLE = none.
        depth: (H, W) m along z, depth at the pixel center.
        light: (H, W, 3) linear RGB, input and output.
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


@njit(cache=True, nogil=True)
def apply_tone_curve(light: Float32, curve: UInt8, color: UInt8) -> None:
    """Write the nearest entry of the tone curve `curve` for each value of `light` to `color`.

    Args:
        light: (N,) linear light; values are clipped to [0, WHITE].
        curve: (K,) sRGB values at K evenly spaced values of light from 0 to WHITE.
        color: (N,) output, sRGB from 0 to 255.
    """
    white, entries = np.float32(WHITE), np.float32((len(curve) - 1) / WHITE)
    for n in range(len(light)):
        index = min(max(light[n], np.float32(0)), white) * entries
        color[n] = curve[np.int32(index + np.float32(0.5))]
