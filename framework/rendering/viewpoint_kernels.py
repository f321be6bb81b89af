"""Kernels of viewpoint.py."""

from __future__ import annotations

import numpy as np

from framework.compilation.kernel_cache import njit
from framework.data import Float32, Float64, Int32


@njit(cache=True, nogil=True)
def sum_level_normals(normals: Float32, up: Float64, cosine: float) -> tuple[Float64, float]:
    """Return the sum (3,) of the face normals in a cone around `up`, and their fraction of the total area.

    Args:
        normals: The face normals (F, 3), with a length proportional to the area.
        up: The axis (3,) of the cone, a unit vector.
        cosine: The cosine of the half angle of the cone.
    """
    total, inside, area = np.zeros(3), 0.0, 0.0
    for f in range(len(normals)):
        x, y, z = normals[f, 0], normals[f, 1], normals[f, 2]
        size = np.sqrt(x * x + y * y + z * z)
        area += size
        if x * up[0] + y * up[1] + z * up[2] > cosine * size:
            inside += size
            total[0], total[1], total[2] = total[0] + x, total[1] + y, total[2] + z
    return total, inside / max(area, 1e-12)


@njit(cache=True, nogil=True)
def draw_fronts(
    points: Float32, normals: Float32, T: Float64, intrinsics: tuple[float, float, float, float], nearest: Int32
) -> None:
    """Write the index of the nearest front-facing point at each pixel to `nearest`.

    Args:
        points: The points (P, 3) in the world frame, m.
        normals: The normals (P, 3) of the points in the world frame.
        T: The camera pose T_world_camera (4, 4).
        intrinsics: The intrinsics fx, fy, cx, cy, px.
        nearest: The output (H, W). Pixels without a point keep their values.
    """
    fx, fy, cx, cy = intrinsics
    height, width = nearest.shape
    depth = np.full(nearest.shape, np.inf)
    for i in range(len(points)):
        x, y, z = points[i, 0] - T[0, 3], points[i, 1] - T[1, 3], points[i, 2] - T[2, 3]
        distance = T[0, 2] * x + T[1, 2] * y + T[2, 2] * z
        if x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2] >= 0 or distance <= 0:
            continue
        u = int(np.rint(fx * (T[0, 0] * x + T[1, 0] * y + T[2, 0] * z) / distance + cx))
        v = int(np.rint(fy * (T[0, 1] * x + T[1, 1] * y + T[2, 1] * z) / distance + cy))
        if 0 <= u < width and 0 <= v < height and distance < depth[v, u]:
            depth[v, u], nearest[v, u] = distance, i
