"""Lifting of detected masks to 3D point clusters."""

from __future__ import annotations

import numpy as np

from framework.data import Detections, Frame, Int32, PointClusters, Pose
from framework.errors import DataError
from framework.refinement.lifting_kernels import count_readings, gather_readings, move_masks


def lift(detections: Detections, frame: Frame, pose: Pose, color_pixels: Int32 | None = None) -> PointClusters:
    """Return the depth readings in each mask as world points.

    Masks may overlap. Cluster k always belongs to detection k, and is empty if its mask has no depth readings.

    Args:
        detections: The detections.
        frame: The frame.
        pose: The camera pose.
        color_pixels: The flat index (H, W) of the color pixel of each depth pixel, -1 = none. If None, color and depth
            have the same pixels. Ignored for exact masks of the depth image.

    Raises:
        DataError: If the size of the masks differs from the frame.
    """
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
    )
