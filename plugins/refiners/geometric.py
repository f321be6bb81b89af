"""Cluster refinement by convexity: the geometric segments that Voxblox++ puts its instances together from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from framework.data import Bool, Frame, Int32, PointClusters
from framework.interfaces import ClusterRefiner
from framework.parameters import check_bounds
from framework.refinement.absolute_orientation import camera_pose, points_at
from framework.refinement.convexity import Limits, segments
from framework.refinement.selection import keep_points


@dataclass
class Geometric(ClusterRefiner):
    """Makes each cluster the union of the convex segments of the depth image that its mask covers.

    The rival idea: Voxblox++ (Grinvald et al., RA-L 2019) cuts the depth image where depth jumps or the surface is
    concave, and gives each segment to the one mask that covers most of it, if that is more than `min_overlap` of its
    pixels. A cluster so loses what its mask caught beside its segments. With `whole_segments` it also grows to their
    pixels outside of the mask, as in Voxblox++: these have exact readings, and the camera's pose, which takes them to
    the world, follows from the points that there are already; where those are too few or on one line, nothing is
    added. A mask that covers no segment loses all its points; clusters keep their index. Points of no cluster stay.
    """

    cell: int = 2  # px, from 1: side of the squares whose readings are averaged
    window: int = 3  # cells, from 1: planes are fitted to squares of 2 window + 1 cells
    noise_factor: float = 3.0  # from 0.1, standard deviations of a structured-light camera's depth that count as noise
    min_noise: float = 0.0  # m, from 0, least standard deviation of depth: where readings are rounded, half a step
    max_slope: float = 4.0  # m per m, from 0.1: steeper against the line of sight, depth jumps (4: 76 degrees)
    max_angle: float = 15.0  # degrees, in (0, 90): a surface bent more towards the camera, and more than noise, is cut
    closing: int = 1  # cells, from 0: gaps in edges up to twice as wide are closed
    min_segment: int = 100  # px, from 1: smaller segments go to those beside them
    min_overlap: float = 0.8  # in [0, 1), share of a segment that a mask must cover to get it
    whole_segments: bool = True  # whether clusters grow to their segments' pixels outside of the mask

    def __post_init__(self) -> None:
        check_bounds(
            self,
            cell=(1, 16),
            window=(1, 16),
            noise_factor=(0.1, 100.0),
            min_noise=(0.0, 1.0),
            max_slope=(0.1, 100.0),
            max_angle=(1e-3, 89.0),
            closing=(0, 16),
            min_segment=(1, 10**9),
            min_overlap=(0.0, 1 - 1e-6),
        )
        self.limits = Limits(self.noise_factor, self.min_noise, self.max_slope, float(np.deg2rad(self.max_angle)))

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        if clusters.exact or len(clusters) == 0:
            return clusters
        labels, count = segments(
            frame.depth,
            frame.camera,
            cell=self.cell,
            window=self.window,
            limits=self.limits,
            closing=self.closing,
            min_pixels=self.min_segment,
        )
        owners = _owners(clusters.pixels, clusters.cluster, len(clusters), labels, count, self.min_overlap)
        kept, missing, missing_owner = _judged(clusters.pixels, clusters.cluster, labels, owners)
        refined = keep_points(clusters, kept)
        return _grown(refined, clusters, frame, missing, missing_owner) if self.whole_segments else refined


@njit(cache=True, nogil=True)
def _owners(pixels: Int32, cluster: Int32, clusters: int, labels: Int32, count: int, min_overlap: float) -> Int32:
    """(count,) the cluster with the most pixels in each segment, the first of equals; -1 = none has enough of them."""
    sizes, covered = np.zeros(count, np.int64), np.zeros((count, clusters), np.int64)
    for label in labels.ravel():
        if label >= 0:
            sizes[label] += 1
    for i in range(len(cluster)):
        label = labels[pixels[i, 1], pixels[i, 0]]
        if label >= 0 and cluster[i] >= 0:
            covered[label, cluster[i]] += 1
    owners = np.full(count, -1, np.int32)
    for s in range(count):
        best = np.argmax(covered[s])
        if covered[s, best] > min_overlap * sizes[s]:
            owners[s] = best
    return owners


@njit(cache=True, nogil=True)
def _judged(pixels: Int32, cluster: Int32, labels: Int32, owners: Int32) -> tuple[Bool, Int32, Int32]:
    """(P,) the points that stay; (A, 2) pixels of owned segments that their owner lacks, and (A,) the owner."""
    height, width = labels.shape
    kept, there = np.ones(len(cluster), np.bool_), np.zeros(labels.shape, np.bool_)
    for i in range(len(cluster)):
        u, v = pixels[i, 0], pixels[i, 1]
        if cluster[i] >= 0:
            kept[i] = labels[v, u] >= 0 and owners[labels[v, u]] == cluster[i]
            there[v, u] |= kept[i]
    count = 0
    for v in range(height):
        for u in range(width):
            there[v, u] |= labels[v, u] < 0 or owners[labels[v, u]] < 0
            count += not there[v, u]
    missing, owner = np.empty((count, 2), np.int32), np.empty(count, np.int32)
    count = 0
    for v in range(height):
        for u in range(width):
            if not there[v, u]:
                missing[count, 0], missing[count, 1] = u, v
                owner[count] = owners[labels[v, u]]
                count += 1
    return kept, missing, owner


def _grown(
    refined: PointClusters, clusters: PointClusters, frame: Frame, missing: Int32, missing_owner: Int32
) -> PointClusters:
    """The refined clusters with the readings at the `missing` pixels, each in its owner's."""
    T_world_camera = camera_pose(clusters, frame) if len(missing) else None
    if T_world_camera is None:
        return refined
    added = points_at(missing, frame, T_world_camera)
    return replace(
        refined,
        points_world=np.concatenate([refined.points_world, added]),
        pixels=np.concatenate([refined.pixels, missing]),
        cluster=np.concatenate([refined.cluster, missing_owner]),
    )
