"""Pictures of point clouds: discs in a depth buffer, shaded where something nearer stands beside them."""

from __future__ import annotations

import cv2
import numpy as np

from framework.data import Float32, Float64, Int32
from framework.figures.point_cloud_kernels import splat_points

SHADE_RANGES_PX = (1, 2, 4)  # how far away neighbors are looked at
SHADE_DEPTH_M = 0.06  # a neighbor that is nearer by this much, all around, darkens to 1/e


def splat(pixels: Float32, depth: Float32, radius: Float32, shape: tuple[int, int]) -> tuple[Int32, Float32]:
    """The nearest point in each pixel of a picture.

    Args:
        pixels: (P, 2) u v.
        depth: (P,) m, the smaller the nearer, of any sign.
        radius: (P,) px, of the disc that stands for a point; 0 = one pixel.
        shape: height, width of the picture.

    Returns:
        (H, W) the index of the point, the first of equally near ones, -1 = none; (H, W) its depth, inf = none.
    """
    nearest = np.full(shape, -1, np.int32)
    buffer = np.full(shape, np.inf, np.float32)
    splat_points(np.ascontiguousarray(pixels, np.float32), depth, radius, nearest, buffer)
    return nearest, buffer


def shading(buffer: Float32) -> Float32:
    """(H, W) brightness in (0, 1] of a depth buffer (H, W) m, inf = nothing there.

    Eye-dome lighting (Boucheny, "Visualisation scientifique de grands volumes de donnees", thesis, 2009): a point is
    darker the farther it lies behind its neighbors in the picture; so borders show, and surfaces have a shape, without
    normals. Where nothing is, nothing shades.
    """
    behind = np.zeros_like(buffer)
    seen = np.isfinite(buffer)
    depth = np.where(seen, buffer, np.float32(1e6))  # infinity less infinity is not a number
    for reach in SHADE_RANGES_PX:
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            shift = np.array([[1, 0, dx * reach], [0, 1, dy * reach]], np.float32)
            beside = cv2.warpAffine(
                depth, shift, depth.shape[::-1], flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
            behind += np.clip(depth - beside, 0, 2 * SHADE_DEPTH_M)
    behind /= 4 * len(SHADE_RANGES_PX) * SHADE_DEPTH_M
    return np.where(seen, np.exp(-behind), 1).astype(np.float32)


def orthographic(
    points: Float32, R_a_view: Float64, shown: Float32, shape: tuple[int, int], margin: float, least_extent: float
) -> tuple[Float32, Float32, float]:
    """Points (P, 3) of frame a as a view along z sees them from far away, zoomed on the bulk of `shown` (S, 3).

    Args:
        R_a_view: (3, 3) its axes x right, y down, z forward, as columns.
        margin: share of the picture to leave free on either side.
        least_extent: m, that the picture covers at least.

    Returns:
        (P, 2) u v in a picture of `shape`; (P,) m along z; the scale, px a meter.
    """
    R = R_a_view.astype(np.float32)
    seen, target = points @ R, shown @ R
    low, high = np.percentile(target[:, :2], [0.5, 99.5], axis=0)
    size = np.array(shape[::-1]) * (1 - 2 * margin)
    scale = float((size / np.maximum(high - low, least_extent)).min())
    center = np.array(shape[::-1]) / 2 - 0.5
    pixels = (seen[:, :2] - (low + high) / 2) * scale + center
    return np.asarray(pixels, np.float32), np.ascontiguousarray(seen[:, 2]), scale
