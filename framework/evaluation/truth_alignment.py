"""Alignment of the ground truth with the world frame of a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Float64, SceneTruth
from framework.errors import DataError
from framework.evaluation.trajectory import align
from framework.geometry import transform

SAME_POSE = 1e-6  # maximum difference between the entries of equal poses; files store rounded poses


def in_map_world(truth: SceneTruth, timestamps: Float64, poses: Float64) -> SceneTruth:
    """Return the ground truth in the world frame of a map.

    Both share one world frame if the run can read the ground-truth poses and the first common pose is equal. Otherwise,
    the ground truth is rigidly aligned with the map by the poses at common times. A ground truth without a trajectory
    is returned unchanged.

    Args:
        truth: Ground truth.
        timestamps: Timestamps (F,) of the frames of the map, s.
        poses: Poses (F, 4, 4) of these frames in the map.

    Raises:
        DataError: The two trajectories have no common time.
    """
    T_map_truth = map_alignment(truth, timestamps, poses)
    if T_map_truth is None:
        return truth
    return replace(truth, points_world=transform(T_map_truth, truth.points_world), trajectory=None)


def map_alignment(truth: SceneTruth, timestamps: Float64, poses: Float64) -> Float64 | None:
    """Return the pose T_map_truth (4, 4) of the ground truth in a map, None = both share one world frame.

    The rule, the arguments and the errors are those of `in_map_world`.
    """
    reference = truth.trajectory
    if reference is None:
        return None
    at = reference.at(timestamps)
    common = at >= 0
    if not common.any():
        raise DataError(
            f"dataset.ground_truth: expected poses at the times of the {len(at)} mapped frames, got none; choose the "
            "ground truth of the same recording"
        )
    T_truth_camera, T_map_camera = reference.T_world_camera[at[common]], poses[common]
    if reference.given and np.allclose(T_truth_camera[0], T_map_camera[0], rtol=0, atol=SAME_POSE):
        return None
    return align(T_truth_camera, T_map_camera)
