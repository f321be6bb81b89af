"""Convex segments of a depth image: connected components without depth jumps or concave creases.

The method computes normals from depth, marks edges at depth jumps and concave surfaces, closes the edges, and labels
connected components. It follows these papers:

- Tateno, Tombari and Navab, "Real-Time and Scalable Incremental Segmentation on Dense SLAM", IROS 2015
- Furrer et al., "Incremental Object Database: Building 3D Models from Multiple Partial Observations", IROS 2018
- Voxblox++: Grinvald et al., "Volumetric Instance-Aware Semantic Mapping and 3D Object Discovery", RA-L 2019

Three changes make borders sharper in the presence of sensor noise:

- planes are fitted in inverse depth, which is linear on a plane in space, in cells of a few pixels;
- at a crease, each cell takes the plane of an adjacent window on its own side (the filter of Kuwahara et al. 1976);
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
    """Return the segment label (H, W) of each pixel, in [0, count) or -1 = none, and the number of segments, count.

    `depth`: (H, W) m, 0 = no reading. Planes are fitted to windows of (2 `window` + 1)^2 cells of `cell` x `cell` px.
    Gaps of up to 2 `closing` cells in edges are closed. Segments of fewer than `min_pixels` pixels are merged with
    their neighbors. `sensor` determines the noise.
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
    """Return the standard deviation, rad, of the angle between two normals, fitted at 1 m with `depth_noise`, m.

    Normals are fitted to windows of (2 `window` + 1)^2 cells of `cell` x `cell` px. At depth z and for the same noise,
    the result is proportional to 1 / z. The slope of a line through M readings has the standard deviation sigma /
    (sqrt(M) * rms offset).
    """
    readings = (cell * (2 * window + 1)) ** 2
    offset = cell * np.sqrt(window * (window + 1) / 3) * 2 / (camera.fx + camera.fy)  # m at 1 m
    return float(np.sqrt(2.0) * depth_noise / (np.sqrt(readings) * offset))


def _closed(edges: Bool, radius: int) -> Bool:
    """Return the edges after morphological closing with a square of side 2 `radius` + 1 cells."""
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(edges.view(np.uint8), cv2.MORPH_CLOSE, square), np.bool_)
