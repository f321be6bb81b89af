"""Detection of large planes in a depth image.

Planes grow over a coarse grid of cells. The method follows PEAC (Feng et al., ICRA 2014) and CAPE (Proenca and Gao,
IROS 2018). Here, planes are fitted in inverse depth, where the noise of stereo and structured-light sensors is
constant. Open3D's RANSAC finds one plane at a time and does not use the image grid.

On the plane n . p = d, the inverse depth is m . r, where m = n / d and r = ((u - cx) / fx, (v - cy) / fy, 1). Inverse
depth is linear in the pixel coordinates. Therefore, a fit is a 3x3 system, and moments of cells can be added.
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
    fractions: Float64  # (K,) fraction of all readings of the frame
    behind: Float64  # (K,) ratio of readings behind the plane to readings on the plane

    def __len__(self) -> int:
        return len(self.m)

    @property
    def normals(self) -> Float64:
        """Unit normals (K, 3) in the camera frame, toward the camera."""
        return np.asarray(-self.m / np.linalg.norm(self.m, axis=1, keepdims=True))

    def chosen(self, which: Bool) -> Planes:
        """Return the planes for which `which` (K,) is True."""
        return Planes(*(values[which] for values in vars(self).values()))


def find_planes(frame: Frame, distance: float, noise: float, min_area: float) -> Planes:
    """Return the large planes of a frame.

    A plane starts at the flattest free cell and grows over adjacent cells. Then, all other cells on the plane are
    added, such as cells on the other side of an occluder.

    Args:
        frame: The frame.
        distance: The maximum rms distance of the readings of a cell from the plane, m, in addition to the noise.
        noise: The noise of inverse depth for KINECT_V1, 1/m. It is scaled up for sensors with more noise.
        min_area: The minimum visible area of a plane, m^2. At least a quarter of it must be connected.
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
    """Return 1 + the index of the nearest plane for each depth reading (H, W), 0 = none.

    A reading is on a plane if its distance to the plane is at most `distance`, m, plus three standard deviations.
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
    """Find the points of clusters that are not on planes.

    A cluster keeps its points on a plane only if they are a large part of the plane.

    Args:
        clusters: The clusters.
        on_plane: 1 + the index (H, W) of the plane at each pixel, 0 = none.
        planes: The number of planes.
        max_own: The maximum fraction of the readings of a plane that is removed from a cluster.

    Returns:
        A Boolean array (P,), True for points to keep.
        A Boolean array (H, W), True for pixels on planes, except the pixels of kept points.
    """
    structure = on_plane > 0
    rows = len(clusters) + 1  # the last row is for points of no cluster
    counts = np.zeros((-(-len(clusters.cluster) // PART), rows, planes + 1), np.int64)
    stays = np.ones((rows, planes + 1), np.bool_)
    kept = find_off_planes(clusters.cluster, clusters.pixels, on_plane, max_own, counts, stays, structure)
    return kept, structure
