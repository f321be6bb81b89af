"""Geometric shapes for furniture, as triangle meshes with smooth normals.

A shape is created at the origin, with z up and lengths in m. Its texture coordinates are its initial 3D coordinates, so
that a solid texture moves with the shape. Flat faces are subdivided, because light is stored at the vertices.

Common parameters are `segments`, the number of subdivisions of a rounded edge or circumference, and `spacing`, the
maximum distance between vertices on flat faces, m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise

import numpy as np

from framework.data import Float64, Int32

SPACING = 0.07  # m, vertex spacing on flat faces, the resolution of baked shadows
WELD = 1e-6  # m, rounding of vertex positions before they are compared


@dataclass(frozen=True)
class Solid:
    """A triangle mesh with texture coordinates.

    Triangles are counterclockwise as seen from outside.
    """

    vertices: Float64  # (V, 3) m
    normals: Float64  # (V, 3) unit vectors
    triangles: Int32  # (F, 3) vertex indices
    texture: Float64  # (V, 3) m, texture coordinates

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        return replace(self, vertices=self.vertices + np.array([x, y, z]))

    def turned(self, axis: str, angle: float) -> Solid:
        """Return a copy that is rotated about the axis x, y or z by an angle in rad."""
        R = axis_rotation(axis, angle)
        return replace(self, vertices=_turn(R, self.vertices), normals=_turn(R, self.normals))

    def deformed(self, shape: Callable[[Float64], Float64]) -> Solid:
        """Return a copy with a function applied to the vertices (V, 3), m."""
        vertices = shape(self.vertices.copy())
        return replace(self, vertices=vertices, normals=smooth_normals(vertices, self.triangles))

    def flat(self, along: int, up: int) -> Solid:
        """Return a copy with 2D texture coordinates (s, t, 0), m.

        The origin is the lower corner. `along` and `up` are the axes of s and t (0 = x, 1 = y, 2 = z).
        """
        s = self.vertices[:, along] - self.vertices[:, along].min()
        t = self.vertices[:, up] - self.vertices[:, up].min()
        return replace(self, texture=np.stack([s, t, np.zeros_like(s)], axis=1))


def axis_rotation(axis: str, angle: float) -> Float64:
    """Return the rotation matrix (3, 3) for an angle in rad about the axis x, y or z."""
    c, s = np.cos(angle), np.sin(angle)
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    R = np.eye(3)
    R[j, j], R[j, k], R[k, j], R[k, k] = c, -s, s, c
    return R


def _turn(R: Float64, vectors: Float64) -> Float64:
    """Rotate vectors (V, 3)."""
    # without BLAS, because its rounding may depend on the number of threads
    return np.asarray(np.einsum("ck,vk->vc", R, vectors))


def smooth_normals(vertices: Float64, triangles: Int32) -> Float64:
    """Return the area-weighted vertex normals (V, 3).

    Vertices at the same position share a normal.
    """
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    faces = np.cross(b - a, c - a)
    _, point = np.unique(np.round(vertices / WELD).astype(np.int64), axis=0, return_inverse=True)
    point = point.reshape(-1)
    sums = np.zeros((point.max() + 1, 3))
    for i in range(3):
        np.add.at(sums, point[triangles[:, i]], faces)
    normals = sums[point]
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


def rounded_box(
    x: float, y: float, z: float, radius: float = 0.004, segments: int = 1, spacing: float = SPACING
) -> Solid:
    """Return a box with rounded edges.

    Lengths are in m.
    """
    half = np.array([x, y, z]) / 2
    radius = min(radius, float(half.min()) * 0.999)
    inner = half - radius
    bevel = radius * np.tan(np.linspace(0, np.pi / 4, segments + 1))
    grids = []
    for h in inner:
        core = np.linspace(-h, h, max(2, int(np.ceil(2 * h / spacing)) + 1))
        grids.append(np.concatenate([-h - bevel[:0:-1], core, h + bevel[1:]]))
    pieces, triangles, count = [], [], 0
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        s, t = np.meshgrid(grids[j], grids[k], indexing="ij")
        for sign in (-1.0, 1.0):
            face = np.empty((*s.shape, 3))
            face[..., axis], face[..., j], face[..., k] = sign * half[axis], s, t
            triangles.append(grid_triangles(s.shape[0], s.shape[1], flip=sign < 0) + count)
            pieces.append(face.reshape(-1, 3))
            count += s.size
    cube = np.concatenate(pieces)
    core_point = np.clip(cube, -inner, inner)
    normals = cube - core_point
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = core_point + radius * normals
    return Solid(vertices, normals, np.concatenate(triangles), _grain_first(vertices, np.array([x, y, z])))


def _grain_first(vertices: Float64, size: Float64) -> Float64:
    """Return texture coordinates (V, 3), m, for which wood grain runs along the longest side."""
    return vertices[:, np.argsort(-size, kind="stable")]


def cushion(x: float, y: float, z: float, plump: float = 0.5) -> Solid:
    """Return a pillow with side lengths in m.

    The thickness decreases by the fraction `plump` towards the seam.
    """
    box = rounded_box(x, y, z, radius=0.45 * z, segments=4, spacing=min(x, y) / 9)

    def swell(p: Float64) -> Float64:
        u, v = np.clip(2 * p[:, 0] / x, -1, 1), np.clip(2 * p[:, 1] / y, -1, 1)
        thickness = (1 - plump) + plump * np.sqrt((1 - u**4) * (1 - v**4))
        p[:, 2] *= thickness
        p[:, :2] *= 1 - 0.06 * (u * u + v * v)[:, None] * np.abs(np.stack([v, u], axis=1))
        return p

    return box.deformed(swell)


@dataclass(frozen=True)
class Section:
    """A horizontal section of a loft: the superellipse |x/a|^n + |y/b|^n = 1 around a center."""

    z: float  # m, height of the section
    a: float  # m, half width along x
    b: float  # m, half width along y
    x: float = 0.0  # m, coordinate of the center
    y: float = 0.0  # m, coordinate of the center
    n: float = 2.0  # exponent; 2 = ellipse, larger = closer to a rectangle
    front: float = 1.0  # scale factor of the half in front of the center (+y), for egg shapes


def loft(sections: Sequence[Section], segments: int = 24, spacing: float = SPACING) -> Solid:
    """Return a solid that connects horizontal sections, from bottom to top."""
    cuts = [sections[0]]
    for below, above in pairwise(sections):
        length = np.hypot(above.z - below.z, max(abs(above.a - below.a), abs(above.b - below.b)))
        steps = max(1, int(np.ceil(length / spacing)))
        for i in range(1, steps + 1):
            f = i / steps
            pairs = zip(astuple(below), astuple(above), strict=True)
            cuts.append(Section(*((1 - f) * low + f * high for low, high in pairs)))
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    c, s = np.cos(angle), np.sin(angle)
    rings = np.empty((len(cuts), segments + 1, 3))
    for i, cut in enumerate(cuts):
        y = cut.b * np.sign(s) * np.abs(s) ** (2 / cut.n)
        rings[i, :, 0] = cut.x + cut.a * np.sign(c) * np.abs(c) ** (2 / cut.n)
        rings[i, :, 1] = cut.y + np.where(y > 0, cut.front, 1.0) * y
        rings[i, :, 2] = cut.z
    rings[:, -1] = rings[:, 0]
    side = rings.reshape(-1, 3)
    triangles = [grid_triangles(len(cuts), segments + 1, flip=True)]
    vertices, normals, count = [side], [smooth_normals(side, triangles[0])], len(side)
    for ring, up in ((rings[0], -1.0), (rings[-1], 1.0)):
        center = ring[:-1].mean(axis=0)
        inner = center + 0.5 * (ring - center)
        cap = np.concatenate([center[None], inner, ring])
        k = np.arange(segments)
        fan = np.stack([np.zeros_like(k), 1 + k, 2 + k], axis=1)
        a, b = 1 + k, 2 + segments + k
        faces = np.concatenate([fan, np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)])
        triangles.append((faces if up > 0 else faces[:, ::-1]) + count)
        vertices.append(cap)
        normals.append(np.tile([0.0, 0.0, up], (len(cap), 1)))
        count += len(cap)
    points = np.concatenate(vertices)
    texture = _grain_first(points, np.ptp(points, axis=0))
    return Solid(points, np.concatenate(normals), np.concatenate(triangles).astype(np.int32), texture)


def lathe(profile: Sequence[tuple[float, float]], segments: int = 24, spacing: float = SPACING) -> Solid:
    """Return a solid of revolution about z from (height, radius) pairs, m."""
    return loft([Section(z, r, r) for z, r in profile], segments, spacing)


def cylinder(radius: float, height: float, top_radius: float | None = None, segments: int = 20) -> Solid:
    """Return a cylinder, or a frustum of a cone, on z = 0.

    Lengths are in m. If `top_radius` is None, it is equal to `radius`.
    """
    top = radius if top_radius is None else top_radius
    return lathe([(0.0, radius), (height, top)], segments)


def leg(thickness: float, height: float, taper: float = 0.7) -> Solid:
    """Return a square furniture leg on z = 0.

    Args:
        thickness: The width at the top, m.
        height: The height, m.
        taper: The width at the bottom, relative to the width at the top.
    """
    a = thickness / 2
    return loft([Section(0.0, taper * a, taper * a, n=8), Section(height, a, a, n=8)], segments=16)


def tube(points: Sequence[tuple[float, float, float]] | Float64, radius: float, segments: int = 10) -> Solid:
    """Return a round rod along a smoothed polyline (N, 3), m."""
    path = _spline(np.asarray(points, np.float64))
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    # the coordinate axis least parallel to all tangents prevents twists of the rod
    aside = np.cross(tangents, np.eye(3)[np.abs(tangents).max(axis=0).argmin()])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(tangents, aside)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radial = np.cos(angle)[None, :, None] * aside[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    vertices = (path[:, None] + radius * radial).reshape(-1, 3)
    triangles = grid_triangles(len(path), segments + 1, flip=True)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    texture = np.stack(np.broadcast_arrays(length[:, None], radius * angle[None], 0.0), axis=-1).reshape(-1, 3)
    return Solid(vertices, radial.reshape(-1, 3), triangles, texture)


def _spline(points: Float64) -> Float64:
    if len(points) == 2:
        return points
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = np.linspace(0, 1, 6, endpoint=False)[:, None]
    pieces = []
    for p0, p1, p2, p3 in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        square, cubic = 2 * p0 - 5 * p1 + 4 * p2 - p3, 3 * p1 - p0 - 3 * p2 + p3
        pieces.append(0.5 * (2 * p1 + (p2 - p0) * t + square * t**2 + cubic * t**3))
    return np.concatenate([*pieces, points[-1:]])


def panel(width: float, height: float, spacing: float = 0.1) -> Solid:
    """Return a flat rectangle in the plane y = 0 that faces +y.

    Lengths are in m. The texture coordinates (s, t, 0) begin at the lower left corner.
    """
    s, t = (np.linspace(0, side, max(2, int(np.ceil(side / spacing)) + 1)) for side in (width, height))
    S, T = np.meshgrid(s, t, indexing="ij")
    zero = np.zeros_like(S)
    vertices = np.stack([width / 2 - S, zero, T], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 1.0, 0.0], (len(vertices), 1))
    texture = np.stack([S, T, zero], axis=-1).reshape(-1, 3)
    return Solid(vertices, normals, grid_triangles(len(s), len(t), flip=False), texture)


def grid_triangles(rows: int, columns: int, flip: bool) -> Int32:
    """Return the triangles (F, 3) of a grid of vertices, two per cell.

    `flip` reverses the order of the vertices.
    """
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return triangles[:, ::-1].copy() if flip else triangles
