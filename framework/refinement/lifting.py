"""Lifting of detected masks to 3D point clusters."""

from __future__ import annotations

from typing import cast

import numpy as np

from framework.data import MAX_COVERAGE, Bool, Detections, Float32, Frame, Int32, Int64, PointClusters, Pose
from framework.errors import DataError
from framework.refinement.lifting_kernels import count_readings, gather_readings, move_masks


def lift(detections: Detections, frame: Frame, pose: Pose, color_pixels: Int32 | None = None) -> PointClusters:
    """Return the depth readings in each mask as world points.

    Masks may overlap. Cluster k always belongs to detection k, and is empty if its mask has no depth readings, or if
    its points exceed the limit of MAX_COVERAGE points per pixel. See `fitting_masks`.

    Args:
        detections: The detections.
        frame: The frame.
        pose: The camera pose.
        color_pixels: The flat index (H, W) of the color pixel of each depth pixel, -1 = none. If None, color and depth
            have the same pixels. Ignored for exact masks of the depth image.

    Raises:
        DataError: If `detections` is not a Detections object, or if the size of its masks differs from the frame.
    """
    if not isinstance(cast(object, detections), Detections):
        raise DataError(f"frame {frame.index}: expected Detections from the detector, got {type(detections).__name__}")
    height, width = frame.depth.shape
    if detections.masks.shape[1:] != (height, width):
        raise DataError(
            f"frame {frame.index}: expected masks of shape {(height, width)}, got {detections.masks.shape[1:]}"
        )
    masks = detections.masks
    of_depth = detections.exact and frame.truth is not None and frame.truth.of_depth
    if color_pixels is not None and not of_depth:
        masks = np.empty_like(masks)
        move_masks(detections.masks, color_pixels, masks)
    # eq. (5) of docs/method.md
    starts = np.zeros(len(detections) * height + 1, np.int64)  # first point of each row of each mask
    count_readings(masks, frame.depth, starts)
    of_rows = starts[1:].reshape(len(detections), height)
    fits = fitting_masks(of_rows.sum(axis=1), detections.scores, MAX_COVERAGE * frame.depth.size)
    of_rows[~fits] = 0
    np.cumsum(starts, out=starts)
    points_world = np.empty((starts[-1], 3), np.float32)
    pixels = np.empty((starts[-1], 2), np.int32)
    cluster = np.empty(starts[-1], np.int32)
    camera = (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy)
    gather_readings(masks, frame.depth, camera, pose.T_world_camera, starts, points_world, pixels, cluster)
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
        detected=detections.detected,
        omitted=int(np.count_nonzero(~fits)),
    )


def fitting_masks(counts: Int64, scores: Float32, limit: int) -> Bool:
    """Return a Boolean array (N,), True for the masks with the highest scores and at most `limit` points together.

    A mask that exceeds the remaining number of points is omitted, and smaller masks with lower scores are kept. Of
    equal scores, the first is preferred.

    Args:
        counts: The number of points (N,) of each mask.
        scores: The score (N,) of each mask.
        limit: The maximum number of points of all masks.
    """
    fits = np.ones(len(counts), np.bool_)
    if counts.sum() <= limit:
        return fits
    left = limit
    for k in np.argsort(-scores, kind="stable"):
        fits[k] = counts[k] <= left
        left -= counts[k] * fits[k]
    return fits
