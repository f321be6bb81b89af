"""Large planes of a depth image by region growing on a coarse grid of cells.

The method follows PEAC (Feng, Taguchi and Kamat, "Fast Plane Extraction in Organized Point Clouds Using Agglomerative
Hierarchical Clustering", ICRA 2014) and CAPE (Proenca and Gao, "Fast Cylinder and Plane Extraction from Depth Cameras
for Visual Odometry", IROS 2018). Planes are fitted in inverse depth.

On a plane n . p = d, the inverse depth is q = 1 / z = m . r, with r = ((u - cx) / fx, (v - cy) / fy, 1) and m = n / d.
It is linear in the pixel coordinates. Therefore, a fit is a 3x3 system, and the moments of a union of cells are sums.
The noise of stereo and structured-light sensors grows with z^2 and is constant in inverse depth. Open3D's RANSAC finds
one plane at a time by random sampling and does not use the image grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from framework.data import Bool, Float64, Frame, PointClusters, UInt8
from framework.refinement.neighborhood import pinhole
from framework.refinement.refine_kernels import PART
from framework.refinement.segmentation.planes_kernels import (
    CELL,
    MAX_PLANES,
    SIGMAS,
    STEP,
    find_off_planes,
    find_plane_cells,
    label_points,
    sum_moments,
    write_flatness,
)


@dataclass(frozen=True)
class Planes:
    """The K planes of one frame, in order of detection."""

    m: Float64  # (K, 3) 1/m, normal / distance; a point p in camera coordinates is on plane k if m . p = 1
    deviations: Float64  # (K,) 1/m, rms deviation of the inverse depth of the readings, limited to the allowed noise
    areas: Float64  # (K,) visible area, m^2
    fractions: Float64  # (K,) fraction of the frame's readings
    behind: Float64  # (K,) ratio of readings behind the plane to readings on the plane

    def __len__(self) -> int:
        return len(self.m)

    @property
    def normals(self) -> Float64:
        """Unit normals (K, 3) in camera coordinates, towards the camera."""
        return np.asarray(-self.m / np.linalg.norm(self.m, axis=1, keepdims=True))

    def chosen(self, which: Bool) -> Planes:
        """Return the planes for which `which` (K,) is True."""
        return Planes(*(values[which] for values in vars(self).values()))


def find_planes(frame: Frame, distance: float, noise: float, min_area: float) -> Planes:
    """Return the planes with a visible area of at least `min_area` m^2, of which at least a quarter is connected.

    A cell of 16x16 px belongs to a plane if the rms distance of its readings is at most `distance`, m, along the
    normal, plus the noise. `noise`, 1/m, is the noise of inverse depth for KINECT_V1, so that the noise at depth z is
    `noise` * z^2. It is scaled up for sensors with more noise. A plane starts at the flattest free cell and grows over
    adjacent cells. Then all cells of the frame that are on the plane are added, including cells on the other side of an
    occluder.
    """
    height, width = frame.camera.shape
    sensor = frame.sensor.noise
    moments = np.zeros(((height + CELL - 1) // CELL, (width + CELL - 1) // CELL, 10))
    sum_moments(frame.depth, pinhole(frame.camera), moments)
    cells = moments.reshape(-1, 10)
    flatness = np.full(len(cells), np.inf)
    write_flatness(cells, distance, noise, sensor, flatness)
    free = flatness < np.inf
    seeds = np.argsort(flatness, kind="stable")[: free.sum()]
    pixel_size = 1.0 / math.sqrt(frame.camera.fx * frame.camera.fy)
    found = np.empty((MAX_PLANES, 7))
    count = find_plane_cells(
        cells, moments.shape[1], seeds, free, distance, noise, sensor, min_area, STEP * pixel_size, found
    )
    return Planes(found[:count, :3].copy(), *found[:count, 3:].T.copy())


def plane_image(frame: Frame, planes: Planes, distance: float) -> UInt8:
    """Return 1 + the index of the nearest plane (H, W) for each depth reading, 0 = none.

    A reading is on a plane if its distance along the normal is at most `distance`, m, plus three standard deviations of
    the plane's noise.
    """
    image = np.zeros(frame.depth.shape, np.uint8)
    if len(planes):
        lengths = np.linalg.norm(planes.m, axis=1)
        label_points(
            frame.depth, pinhole(frame.camera), planes.m.astype(np.float32), lengths.astype(np.float32),
            (distance * lengths).astype(np.float32), (SIGMAS * planes.deviations).astype(np.float32), image,
        )  # fmt: skip
    return image


def off_planes(clusters: PointClusters, on_plane: UInt8, planes: int, max_own: float) -> tuple[Bool, Bool]:
    """Return a point array (P,), True for points to keep, and a pixel array (H, W), True for structure.

    `on_plane` is the `plane_image`. A cluster's points on a plane are removed if they are at most a fraction `max_own`
    of the plane's readings. Structure pixels are on a plane, and not in a cluster that keeps its points on this plane.
    """
    structure = on_plane > 0
    rows = len(clusters) + 1  # the last row is for points of no cluster
    counts = np.zeros((-(-len(clusters.cluster) // PART), rows, planes + 1), np.int64)
    stays = np.ones((rows, planes + 1), np.bool_)
    kept = find_off_planes(clusters.cluster, clusters.pixels, on_plane, max_own, counts, stays, structure)
    return kept, structure
