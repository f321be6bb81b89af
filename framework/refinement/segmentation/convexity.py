"""Convex segments of a depth image.

The method computes normals from depth, and marks edges at depth jumps and concave creases. The segments are the
connected components without edges. It follows these papers:

- Tateno, Tombari and Navab, "Real-Time and Scalable Incremental Segmentation on Dense SLAM", IROS 2015
- Furrer et al., "Incremental Object Database: Building 3D Models from Multiple Partial Observations", IROS 2018
- Voxblox++: Grinvald et al., "Volumetric Instance-Aware Semantic Mapping and 3D Object Discovery", RA-L 2019

Three changes make borders sharper in the presence of sensor noise:

- planes are fitted in inverse depth, which is linear on a plane, in cells of a few pixels;
- at a crease, each cell uses the plane of an adjacent window on its own side (Kuwahara et al., 1976);
- pixels at edges join the adjacent segment that best predicts their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from framework.data import Bool, Camera, Float32, Int32
from framework.refinement.segmentation.convexity_kernels import (
    Noise,
    absorbed,
    best_planes,
    connected,
    count_edges,
    fit_planes,
    mean_inverse_depth,
    pixel_labels,
)
from framework.sensors.noise_models import SensorKind


@dataclass(frozen=True)
class Limits:
    """Limits for a continuous and convex surface."""

    noise_factor: float  # maximum depth difference that counts as noise, in standard deviations
    min_noise: float  # minimum standard deviation of depth, m; for quantized depth
    max_slope: float  # maximum change of depth with lateral distance, m per m
    max_angle: float  # maximum angle of a concave bend, in addition to the noise of the angle, rad


def segments(
    depth: Float32, camera: Camera, *, cell: int, window: int, limits: Limits, closing: int, min_pixels: int,
    sensor: SensorKind = SensorKind.KINECT_V1,
) -> tuple[Int32, int]:  # fmt: skip
    """Return the segment (H, W) of each pixel, -1 = none, and the number of segments.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        camera: The camera.
        cell: The side of a cell, px.
        window: The radius of the windows for plane fits, cells.
        limits: The limits for a continuous and convex surface.
        closing: The radius of the morphological closing of edges, cells.
        min_pixels: The minimum number of pixels of a segment. Smaller segments are merged with their neighbors.
        sensor: The sensor, which determines the noise.
    """
    slope = np.float32(limits.max_slope * cell * 2 / (camera.fx + camera.fy))  # relative change of depth per cell
    pinhole = np.array(
        [camera.fx / cell, camera.fy / cell, (camera.cx + 0.5) / cell - 0.5, (camera.cy + 0.5) / cell - 0.5], np.float32
    )
    noise = Noise(limits.noise_factor, limits.min_noise, *sensor.noise[:3])
    inverse = mean_inverse_depth(depth, cell, noise, slope)
    fits = fit_planes(inverse, window, noise, slope)
    planes = best_planes(inverse, fits, window, noise)
    edges = count_edges(planes, pinhole, noise, limits.max_angle, normal_sigma(1.0, window, cell, camera))
    min_cells = max(min_pixels // cell**2, 1)
    labels, count = connected(inverse, _closed(edges, closing), noise, slope, min_cells)
    for _ in range(2 + 2 * closing):  # maximum width of an edge, cells
        labels, planes = absorbed(inverse, labels, planes, noise)
    # poles and legs consist of edges, so cells without a segment are connected by depth alone
    rest, rest_count = connected(inverse, (labels >= 0) | (inverse <= 0), noise, slope, min_cells)
    labels = np.where(rest >= 0, rest + count, labels)
    return pixel_labels(depth, inverse, labels, planes, cell, noise, slope), int(count + rest_count)


def normal_sigma(depth_noise: float, window: int, cell: int, camera: Camera) -> float:
    """Return the standard deviation of the angle between two fitted normals at a depth of 1 m, rad.

    Args:
        depth_noise: The standard deviation of depth, m.
        window: The radius of the windows for plane fits, cells.
        cell: The side of a cell, px.
        camera: The camera.
    """
    # the slope of a line through M readings has the standard deviation sigma / (sqrt(M) * rms offset)
    readings = (cell * (2 * window + 1)) ** 2
    offset = cell * np.sqrt(window * (window + 1) / 3) * 2 / (camera.fx + camera.fy)  # m at 1 m
    return float(np.sqrt(2.0) * depth_noise / (np.sqrt(readings) * offset))


def _closed(edges: Bool, radius: int) -> Bool:
    """Return the edges after morphological closing with a square of the given radius, cells."""
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(edges.view(np.uint8), cv2.MORPH_CLOSE, square), np.bool_)
