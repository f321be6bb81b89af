"""Cluster refinement by connectivity: an object hangs together in 3D, what a mask caught beside it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Float32, Frame, Int32, PointClusters
from framework.interfaces import ClusterRefiner
from framework.parameters import check_bounds
from framework.refinement.neighborhood import grouped
from framework.refinement.selection import keep_points
from framework.refinement.union_find import root, unite

Int64 = npt.NDArray[np.int64]


@dataclass
class LargestComponent(ClusterRefiner):
    """Keeps of each cluster its largest piece that is connected in 3D.

    Two points of a cluster are connected when they are at most `reach` pixels apart in the image and their depths
    differ by less than `gap` + `gap_per_depth` * depth of the nearer one: the spacing of depth readings and the noise
    of the sensor both grow with depth. Of equally large pieces the one seen first in the image stays. A dropped point
    leaves the arrays, clusters keep their index.
    """

    gap: float = 0.03  # m, from 0
    gap_per_depth: float = 0.02  # m per m, from 0
    reach: int = 2  # px, from 1; 2 bridges single missing readings

    def __post_init__(self) -> None:
        check_bounds(
            self,
            gap=(0.0, np.inf),
            gap_per_depth=(0.0, np.inf),
            reach=(1, 16),
        )

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if clusters.exact:
            return clusters
        order, firsts = grouped(clusters.cluster, len(clusters))
        kept = clusters.cluster < 0  # points of no cluster are nobody's piece
        _keep_largest(clusters.pixels, order, firsts, frame.depth, self.gap, self.gap_per_depth, self.reach, kept)
        return keep_points(clusters, kept)


@njit(cache=True, nogil=True, parallel=True)
def _keep_largest(
    pixels: Int32, order: Int64, firsts: Int64, depth: Float32,
    gap: float, gap_per_depth: float, reach: int, kept: npt.NDArray[np.bool_],
) -> None:  # fmt: skip
    for k in prange(len(firsts) - 1):
        if firsts[k + 1] > firsts[k]:
            _keep_largest_of(pixels, order[firsts[k] : firsts[k + 1]], depth, gap, gap_per_depth, reach, kept)


@njit(cache=True, nogil=True)
def _keep_largest_of(
    pixels: Int32, members: Int64, depth: Float32,
    gap: float, gap_per_depth: float, reach: int, kept: npt.NDArray[np.bool_],
) -> None:  # fmt: skip
    u0, v0, u1, v1 = pixels[members[0], 0], pixels[members[0], 1], 0, 0
    for i in members:
        u0, v0 = min(u0, pixels[i, 0]), min(v0, pixels[i, 1])
        u1, v1 = max(u1, pixels[i, 0]), max(v1, pixels[i, 1])
    rows, columns = v1 - v0 + 1, u1 - u0 + 1
    parents = np.full(rows * columns, -1, np.int32)  # union-find over the cells; -1 = not in the cluster
    for i in members:
        cell = (pixels[i, 1] - v0) * columns + pixels[i, 0] - u0
        parents[cell] = cell
    for i in members:
        u, v = pixels[i, 0], pixels[i, 1]
        z = depth[v, u]
        cell = (v - v0) * columns + u - u0
        for dv in range(min(reach, v1 - v) + 1):  # the half-plane below: each pair of neighbors is met once
            for du in range(-min(reach, u - u0) if dv > 0 else 1, min(reach, u1 - u) + 1):
                neighbor = cell + dv * columns + du
                if parents[neighbor] < 0 or parents[neighbor] == parents[cell]:
                    continue  # not in the cluster, or united already
                z_neighbor = depth[v + dv, u + du]
                if abs(z - z_neighbor) < gap + gap_per_depth * min(z, z_neighbor):
                    unite(parents, cell, neighbor)
    sizes = np.zeros(rows * columns, np.int32)
    for i in members:
        sizes[root(parents, (pixels[i, 1] - v0) * columns + pixels[i, 0] - u0)] += 1
    largest = np.argmax(sizes)
    for i in members:
        kept[i] = root(parents, (pixels[i, 1] - v0) * columns + pixels[i, 0] - u0) == largest
