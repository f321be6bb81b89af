"""Lifting of detected masks to 3D point clusters (equation [5] of the paper)."""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from framework.data import Bool, Detections, Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.errors import DataError


def lift(detections: Detections, frame: Frame, pose: Pose) -> PointClusters:
    """Each mask's pixels that have a depth reading, as points in the world: eq. [5] of the paper.

    Overlapping masks give overlapping clusters. A mask without any reading gives an empty cluster, so that cluster k
    always is detection k. Raises DataError for masks of another size than the frame, and for what are no Detections.
    """
    if not isinstance(cast(object, detections), Detections):
        raise DataError(f"frame {frame.index}: a detector must return Detections, found {type(detections).__name__}")
    height, width = frame.depth.shape
    if detections.masks.shape[1:] != (height, width):
        raise DataError(f"frame {frame.index}: masks must be {(height, width)}, found {detections.masks.shape[1:]}")
    starts = np.zeros(len(detections) * height + 1, np.int64)  # of each row of each mask among all points
    _count_readings(detections.masks, frame.depth, starts)
    np.cumsum(starts, out=starts)
    points_world = np.empty((starts[-1], 3), np.float32)
    pixels = np.empty((starts[-1], 2), np.int32)
    cluster = np.empty(starts[-1], np.int32)
    camera = (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy)
    _gather_readings(detections.masks, frame.depth, camera, pose.T_world_camera, starts, points_world, pixels, cluster)
    return PointClusters(
        points_world=points_world,
        pixels=pixels,
        cluster=cluster,
        class_probabilities=detections.class_probabilities,
        scores=detections.scores,
        classes=detections.classes,
        exact=detections.exact,
        embeddings=detections.embeddings,
        embedding_space=detections.embedding_space,
    )


@njit(cache=True, nogil=True, parallel=True)
def _count_readings(masks: Bool, depth: Float32, counts: npt.NDArray[np.int64]) -> None:
    """Sets counts (N * H + 1,) to how many pixels of each row of each mask have a reading, one place on."""
    height = depth.shape[0]
    for row in prange(masks.shape[0] * height):
        k, v = row // height, row % height
        count = 0
        for u in range(depth.shape[1]):
            count += masks[k, v, u] & (depth[v, u] > 0)
        counts[row + 1] = count


@njit(cache=True, nogil=True, parallel=True)
def _gather_readings(
    masks: Bool,
    depth: Float32,
    camera: tuple[float, float, float, float],
    T_world_camera: Float64,
    starts: npt.NDArray[np.int64],
    points_world: Float32,
    pixels: Int32,
    cluster: Int32,
) -> None:
    """Fills points_world (P, 3), pixels (P, 2) and cluster (P,) with the masks' readings, row by row."""
    height = depth.shape[0]
    fx, fy, cx, cy = camera
    T = T_world_camera
    for row in prange(masks.shape[0] * height):
        if starts[row] == starts[row + 1]:
            continue
        k, v = row // height, row % height
        p = starts[row]
        for u in range(depth.shape[1]):
            z = depth[v, u]
            if masks[k, v, u] and z > 0:
                x, y = (u - cx) / fx * z, (v - cy) / fy * z
                for i in range(3):
                    points_world[p, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]
                pixels[p, 0], pixels[p, 1] = u, v
                cluster[p] = k
                p += 1
