"""Kernels of lights.py and renderer.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Bool, Float32, Float64, Int32, Int64, UInt8
from framework.rendering.rasterizer_kernels import NO_TRIANGLE
from framework.synthetic.paints import DARK, EMISSION, SHINY
from framework.synthetic.texture_kernels import surface_color

EDGE_STEP = 0.04  # minimum depth step at an edge, relative to the depth
WHITE = 2.2  # linear light that is mapped to sRGB white; lamps and windows may saturate
GLANCED_OFF = np.float32(np.deg2rad(60.0))  # rad, angle of incidence from which a mirror loses all readings
GRAZING = np.float32(0.05)  # lower limit of the cosine of the angle of incidence for the footprint of a pixel


class LitSurfaces(NamedTuple):
    """Triangles of a room with precomputed light."""

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
    """Compute the mean light (V, 3), linear RGB, that each vertex receives from other surfaces.

    For cosine-distributed directions, the mean is the irradiance.

    Args:
        triangle: The triangle (V, D) that is visible from each vertex in D directions, -1 = none.
        uv: The barycentric weights (V, D, 2) of the second and third vertex.
        triangles: The vertex indices (F, 3).
        materials: The row of `reflectance` (F,) of each triangle.
        reflectance: The reflectance (M, 3), linear RGB.
        irradiance: The irradiance (V, 3), linear RGB.
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
    """Compute the light and the angle of incidence at each pixel.

    Both outputs are 0 for pixels without a surface.

    Args:
        s: The surfaces.
        view: The camera.
        triangle: The visible triangle (H, W), NO_TRIANGLE = none.
        depth: The depth (H, W), m along z.
        uv: The barycentric weights (H, W, 2) of the second and third vertex.
        light: The output light (H, W, 3), linear RGB.
        incidence: The output cosine of the angle of incidence (H, W).
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
    """Compute the fraction of depth readings that are lost on dark and shiny materials.

    Args:
        materials: The row of `table` (F,) of each triangle.
        table: The materials (M, 14), see paints.material_table.
        triangle: The visible triangle (H, W), NO_TRIANGLE = none.
        incidence: The cosine of the angle of incidence (H, W).
        lost: The output fraction (H, W).
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
            # 0 at perpendicular incidence, 1 from the angle GLANCED_OFF on
            slant = min((one - incidence[v, u]) / mirrored_away, one)
            lost[v, u] = dark + (one - dark) * shiny * slant


@njit(cache=True, nogil=True, inline="always")
def _cosine(view, normals, f, u, v):
    """Return the cosine of the angle between a ray and the normal of triangle f."""
    T, x, y = view.T_world_camera, (u - view.cx) / view.fx, (v - view.cy) / view.fy
    along = 0.0
    for axis in range(3):
        along += (T[axis, 0] * x + T[axis, 1] * y + T[axis, 2]) * normals[f, axis]
    return min(abs(along) / np.sqrt(x * x + y * y + 1), 1.0)


@njit(cache=True, nogil=True, inline="always")
def _light_of(texture, irradiance, triangles, materials, table, f, b, c, pixel, cosine):
    """Return the emitted and reflected light, linear RGB, at a point of triangle f.

    b and c are the barycentric weights of the second and third vertex. `pixel` is the width of a pixel at the point, m.
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
    """Return the mask (H, W) of the pixels at the border between two parts or at a depth step.

    Args:
        triangle: The visible triangle (H, W), NO_TRIANGLE = none.
        parts: The part (F,) of each triangle.
        depth: The depth (H, W), m along z.
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
    """Antialias N pixels at edges by averaging S samples.

    Args:
        s: The surfaces.
        view: The camera.
        u: The columns (N,) of the pixels.
        v: The rows (N,) of the pixels.
        offsets: The offsets (S, 2) of the samples from the pixel center, px.
        triangle: The visible triangle (N, S) of each sample, NO_TRIANGLE = none.
        distance: The depth (N, S) of each sample, m along z.
        uv: The barycentric weights (N, S, 2) of the second and third vertex.
        own: The visible triangle (H, W) at the pixel center, NO_TRIANGLE = none.
        depth: The depth (H, W) at the pixel center, m along z.
        light: The light (H, W, 3), linear RGB, input and output.
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
            # a sample on the same part and at a similar depth has the light of the pixel center
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
    """Convert linear light to sRGB with a lookup table.

    Args:
        light: The linear light (N,).
        curve: The sRGB values (K,) for evenly spaced values of light from 0 to WHITE.
        color: The output values (N,), sRGB from 0 to 255.
    """
    white, entries = np.float32(WHITE), np.float32((len(curve) - 1) / WHITE)
    for n in range(len(light)):
        index = min(max(light[n], np.float32(0)), white) * entries
        color[n] = curve[np.int32(index + np.float32(0.5))]
