"""Kernels of rasterizer.py."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, Int32

NO_TRIANGLE = -1  # index for pixels without a triangle
CHUNK = 32  # number of triangles culled together
SLACK = 0.01  # px, margin of the bounds for rounding errors
CELLS = 1023  # largest cell index along each axis of the bounding cube
NEAR = 1e-9  # m, near plane for the bounds of triangles partly behind the camera


@njit(cache=True, nogil=True)
def morton_codes(vertices: Float32, triangles: Int32) -> npt.NDArray[np.uint32]:
    """Return the Morton code (F,) of the centroid of each triangle.

    Args:
        vertices: The vertices (V, 3), m.
        triangles: The triangles (F, 3).
    """
    middle = np.empty((len(triangles), 3), np.float32)
    for f in range(len(triangles)):
        for axis in range(3):
            corners = (
                vertices[triangles[f, 0], axis] + vertices[triangles[f, 1], axis] + vertices[triangles[f, 2], axis]
            )
            middle[f, axis] = corners / 3
    low, side = np.zeros(3, np.float32), np.float32(0)
    for axis in range(3 if len(middle) else 0):
        lowest = highest = middle[0, axis]
        for f in range(len(middle)):
            lowest, highest = min(lowest, middle[f, axis]), max(highest, middle[f, axis])
        low[axis], side = lowest, max(side, highest - lowest)
    codes = np.zeros(len(triangles), np.uint32)
    if side > 0:
        for f in range(len(triangles)):
            for axis in range(3):
                cell = np.uint32((middle[f, axis] - low[axis]) / side * CELLS)
                for bit in range(10):
                    codes[f] |= ((cell >> np.uint32(bit)) & np.uint32(1)) << np.uint32(3 * bit + axis)
    return codes


@njit(cache=True, nogil=True)
def bounding_spheres(vertices: Float32, triangles: Int32) -> Float64:
    """Return the bounding sphere (center and radius, m) of each chunk of consecutive triangles.

    The result (ceil(F / CHUNK), 4) contains x, y, z and the radius.

    Args:
        vertices: The vertices (V, 3), m.
        triangles: The triangles (F, 3).
    """
    spheres = np.zeros(((len(triangles) + CHUNK - 1) // CHUNK, 4))
    for chunk in range(len(spheres)):
        part = triangles[chunk * CHUNK : (chunk + 1) * CHUNK]
        low, high = np.array([np.inf, np.inf, np.inf]), np.array([-np.inf, -np.inf, -np.inf])
        for f in range(len(part)):
            for corner in range(3):
                for axis in range(3):
                    at = vertices[part[f, corner], axis]
                    low[axis], high[axis] = min(low[axis], at), max(high[axis], at)
        squares = 0.0
        for axis in range(3):
            spheres[chunk, axis] = 0.5 * (low[axis] + high[axis])
            squares += (high[axis] - low[axis]) ** 2
        spheres[chunk, 3] = 0.5 * np.sqrt(squares)
    return spheres


@njit(cache=True, nogil=True)
def draw_triangles(
    vertices: Float32,
    triangles: Int32,
    order: Int32,
    spheres: Float64,
    T_world_camera: Float64,
    intrinsics: tuple[float, float, float, float],
    x: Float64,
    y: Float64,
    triangle: Int32,
    depth: Float32,
    uv: Float32,
) -> None:
    """Rasterize triangles into the arrays of a `VisibilityBuffer`.

    Args:
        vertices: The vertices (V, 3) in the world frame, m.
        triangles: The triangles (F, 3).
        order: The index (F,) to write for each triangle.
        spheres: The bounding spheres of the chunks, from `bounding_spheres`.
        T_world_camera: The camera pose (4, 4).
        intrinsics: The intrinsics fx, fy, cx, cy, px.
        x: The coordinate (W,) of each pixel column at z = 1.
        y: The coordinate (H,) of each pixel row at z = 1.
        triangle: The output (H, W), the index of the visible triangle, NO_TRIANGLE = none.
        depth: The output (H, W), m, 0 = none.
        uv: The output (H, W, 2), the barycentric weights of the second and third vertex.
    """
    height, width = triangle.shape
    closeness = np.zeros((height, width))  # 1/m, inverse depth; 0 = no surface
    triangle[:] = NO_TRIANGLE  # the first pass writes indices into `triangles`, the second pass values of `order`
    for chunk in range(len(spheres)):
        center = _in_camera(T_world_camera, spheres[chunk, 0], spheres[chunk, 1], spheres[chunk, 2])
        if _is_out_of_sight(center, spheres[chunk, 3], intrinsics, width, height):
            continue
        for f in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(triangles))):
            a, b, c = _corners(vertices, triangles, f, T_world_camera)
            u0, u1, v0, v1 = _pixels_of(a, b, c, intrinsics, width, height)
            if u1 <= u0 or v1 <= v0:
                continue
            ea, eb, ec, volume = _edge_functions(a, b, c)
            if volume == 0:
                continue  # edge-on
            scale = 1 / volume
            for v in range(np.uint64(v0), np.uint64(v1)):
                row_a, row_b, row_c = ea[1] * y[v] + ea[2], eb[1] * y[v] + eb[2], ec[1] * y[v] + ec[2]
                for u in range(np.uint64(u0), np.uint64(u1)):
                    wa, wb, wc = ea[0] * x[u] + row_a, eb[0] * x[u] + row_b, ec[0] * x[u] + row_c
                    if (wa >= 0) & (wb >= 0) & (wc >= 0):
                        near = (wa + wb + wc) * scale
                        if near > closeness[v, u]:
                            closeness[v, u] = near
                            triangle[v, u] = f
    for v in range(height):
        drawn = NO_TRIANGLE
        for u in range(width):
            f = triangle[v, u]
            if f == NO_TRIANGLE:
                depth[v, u], uv[v, u, 0], uv[v, u, 1] = 0, 0, 0
                continue
            if f != drawn:
                drawn = f
                a, b, c = _corners(vertices, triangles, f, T_world_camera)
                ea, eb, ec, _ = _edge_functions(a, b, c)
            wa = ea[0] * x[u] + (ea[1] * y[v] + ea[2])
            wb = eb[0] * x[u] + (eb[1] * y[v] + eb[2])
            wc = ec[0] * x[u] + (ec[1] * y[v] + ec[2])
            fraction = 1 / (wa + wb + wc)
            triangle[v, u] = order[f]
            depth[v, u], uv[v, u, 0], uv[v, u, 1] = 1 / closeness[v, u], wb * fraction, wc * fraction


@njit(cache=True, nogil=True)
def nearest(triangle: Int32, uv: Float32, triangles: Int32, labels: Int32, image: Int32) -> None:
    """Write the label of the vertex with the largest barycentric weight at each pixel.

    Args:
        triangle: The visible triangle (H, W) at each pixel, NO_TRIANGLE = none.
        uv: The barycentric weights (H, W, 2) of the second and third vertex.
        triangles: The triangles (F, 3).
        labels: The label (V,) of each vertex.
        image: The output (H, W). Pixels without a triangle keep their values.
    """
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            if f != NO_TRIANGLE:
                b, c = uv[v, u, 0], uv[v, u, 1]
                a = 1 - b - c
                image[v, u] = labels[triangles[f, 0 if a >= b and a >= c else (1 if b >= c else 2)]]


@njit(cache=True, nogil=True)
def interpolate(triangle: Int32, uv: Float32, triangles: Int32, values: Float32, image: Float32) -> None:
    """Interpolate vertex values at each pixel.

    Args:
        triangle: The visible triangle (H, W) at each pixel, NO_TRIANGLE = none.
        uv: The barycentric weights (H, W, 2) of the second and third vertex.
        triangles: The triangles (F, 3).
        values: The values (V, C) of the vertices.
        image: The output (H, W, C). Pixels without a triangle keep their values.
    """
    for v in range(triangle.shape[0]):
        for u in range(triangle.shape[1]):
            f = triangle[v, u]
            if f == NO_TRIANGLE:
                continue
            a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
            wb, wc = uv[v, u, 0], uv[v, u, 1]
            wa = np.float32(1) - wb - wc
            for k in range(values.shape[1]):
                image[v, u, k] = wa * values[a, k] + wb * values[b, k] + wc * values[c, k]


@njit(cache=True, nogil=True, inline="always")
def _corners(vertices, triangles, f, T_world_camera):
    """Return the three corners of a triangle in the camera frame, m."""
    i, j, k = np.uint64(triangles[f, 0]), np.uint64(triangles[f, 1]), np.uint64(triangles[f, 2])
    return (
        _in_camera(T_world_camera, vertices[i, 0], vertices[i, 1], vertices[i, 2]),
        _in_camera(T_world_camera, vertices[j, 0], vertices[j, 1], vertices[j, 2]),
        _in_camera(T_world_camera, vertices[k, 0], vertices[k, 1], vertices[k, 2]),
    )


@njit(cache=True, nogil=True, inline="always")
def _edge_functions(a, b, c):
    """Return the three edge functions of a triangle and the nonnegative triple product of its corners."""
    # The barycentric weight of a corner is proportional to the dot product of the ray with the cross product of the
    # other two corners. At a common edge, two triangles compute the same value with opposite signs, so there is no gap.
    ea, eb, ec = _cross(b, c), _cross(c, a), _cross(a, b)
    volume = a[0] * ea[0] + a[1] * ea[1] + a[2] * ea[2]
    if volume < 0:  # back side
        return (-ea[0], -ea[1], -ea[2]), (-eb[0], -eb[1], -eb[2]), (-ec[0], -ec[1], -ec[2]), -volume
    return ea, eb, ec, volume


@njit(cache=True, nogil=True, inline="always")
def _in_camera(T, x, y, z):
    """Transform a world point to the camera frame."""
    x, y, z = x - T[0, 3], y - T[1, 3], z - T[2, 3]
    return (
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )


@njit(cache=True, nogil=True, inline="always")
def _cross(p, q):
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


@njit(cache=True, nogil=True)
def _is_out_of_sight(center, radius, intrinsics, width, height):
    """Return True if a sphere in the camera frame is completely outside the view frustum."""
    fx, fy, cx, cy = intrinsics
    x, y, z = center
    for distance, slope in (
        (fx * x + (cx + 1) * z, np.hypot(fx, cx + 1)),
        ((width - cx) * z - fx * x, np.hypot(fx, width - cx)),
        (fy * y + (cy + 1) * z, np.hypot(fy, cy + 1)),
        ((height - cy) * z - fy * y, np.hypot(fy, height - cy)),
        (z, 1.0),
    ):
        if distance < -radius * slope:
            return True
    return False


@njit(cache=True, nogil=True, inline="always")
def _pixels_of(a, b, c, intrinsics, width, height):
    """Return the first column, end column, first row and end row of a triangle in the camera frame.

    The ends are exclusive.
    """
    fx, fy, cx, cy = intrinsics
    if min(a[2], b[2], c[2]) > NEAR:
        za, zb, zc = 1 / a[2], 1 / b[2], 1 / c[2]
        ua, ub, uc = a[0] * za, b[0] * zb, c[0] * zc
        va, vb, vc = a[1] * za, b[1] * zb, c[1] * zc
        left, right, top, bottom = min(ua, ub, uc), max(ua, ub, uc), min(va, vb, vc), max(va, vb, vc)
    else:
        left, right, top, bottom = _bounds_in_front(a, b, c)
    left, right = max(fx * left + cx - SLACK, 0.0), min(fx * right + cx + SLACK, width - 1.0)
    top, bottom = max(fy * top + cy - SLACK, 0.0), min(fy * bottom + cy + SLACK, height - 1.0)
    if not (left <= right and top <= bottom):
        return 0, 0, 0, 0
    return int(np.ceil(left)), int(right) + 1, int(np.ceil(top)), int(bottom) + 1


@njit(cache=True, nogil=True)
def _bounds_in_front(a, b, c):
    """Return the left, right, top and bottom of a triangle at z = 1, after clipping at the near plane."""
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for p, q in ((a, b), (b, c), (c, a)):
        x, y, z = p
        if z <= NEAR and q[2] > NEAR:  # the edge enters the visible side of the near plane
            s = (NEAR - z) / (q[2] - z)
            x, y, z = x + s * (q[0] - x), y + s * (q[1] - y), NEAR
        if z >= NEAR:
            left, right, top, bottom = min(left, x / z), max(right, x / z), min(top, y / z), max(bottom, y / z)
        if p[2] > NEAR and q[2] <= NEAR:  # the edge leaves the visible side
            s = (NEAR - p[2]) / (q[2] - p[2])
            x, y = (p[0] + s * (q[0] - p[0])) / NEAR, (p[1] + s * (q[1] - p[1])) / NEAR
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    return left, right, top, bottom
