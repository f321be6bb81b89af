"""The ground truth in the world of a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from framework.data import Float64, SceneTruth
from framework.errors import DataError
from framework.evaluation.trajectory import align
from framework.geometry import transform

SAME_POSE = 1e-6  # largest difference of an entry of a pose that was written to a file and read


def in_map_world(truth: SceneTruth, timestamps: Float64, poses: Float64) -> SceneTruth:
    """Return the ground truth in the world of the map with this trajectory.

    A map that begins with a given pose of the truth's trajectory is in the world of the truth. The truth is moved for
    all others: rigidly, to the best agreement of the poses at the same times.

    Args:
        truth: The ground truth.
        timestamps: (F,) s, of the map's frames.
        poses: (F, 4, 4) T_map_camera.

    Raises:
        DataError: The two trajectories have no time in common.
    """
    reference = truth.trajectory
    if reference is None:
        return truth
    at = reference.at(timestamps)
    common = at >= 0
    if not common.any():
        raise DataError(
            f"dataset.ground_truth: expected camera poses of the mapped frames to align the map, got {len(at)} frames"
            " and none with the time of a pose; choose a ground truth of the same recording"
        )
    T_truth_camera, T_map_camera = reference.T_world_camera[at[common]], poses[common]
    if reference.given and np.allclose(T_truth_camera[0], T_map_camera[0], rtol=0, atol=SAME_POSE):
        return truth
    T_map_truth = align(T_truth_camera, T_map_camera)
    return replace(truth, points_world=transform(T_map_truth, truth.points_world), trajectory=None)
