"""Tests for trajectory errors of known motions, also compared with evo."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Pose
from framework.errors import DataError
from framework.evaluation.trajectory import evaluate, umeyama
from framework.geometry import exp_se3

rng = np.random.default_rng(3)


def walk(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return a random walk of `count` poses, T_world_camera."""
    generator = np.random.default_rng(seed)
    poses = [exp_se3(generator.normal(0, 1, 6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ exp_se3(generator.normal(0, 0.1, 6)))
    return poses


def test_trajectory_error_of_rigid_motion_is_zero():
    true = walk(20)
    S = exp_se3(np.array([3.0, -2.0, 1.0, 0.5, 1.0, -0.7]))
    error = evaluate(true, [Pose(S @ T) for T in true])
    assert error.ate_rmse_m < 1e-12
    assert error.rpe_rmse_m < 1e-12
    assert error.rpe_rotation_rmse_rad < 1e-12
    assert (error.frames, error.pairs) == (20, 19)


def test_trajectory_alignment_does_not_correct_scale():
    """The positions -1, 0, 1 m are estimated as -1.1, 0, 1.1 m."""
    true = [exp_se3(np.array([x, 0, 0, 0, 0, 0])) for x in (-1.0, 0.0, 1.0)]
    estimated = [Pose(exp_se3(np.array([1.1 * x, 0, 0, 0, 0, 0]))) for x in (-1.0, 0.0, 1.0)]
    error = evaluate(true, estimated)
    assert error.ate_rmse_m == pytest.approx(np.sqrt(0.02 / 3), abs=1e-12)
    assert error.rpe_rmse_m == pytest.approx(0.1, abs=1e-12)


def test_rpe_measures_rotation_drift_per_step():
    """The camera is static, but the estimate rotates by 0.02 rad per frame."""
    error = evaluate([np.eye(4)] * 10, [Pose(exp_se3(np.array([0, 0, 0, 0, 0.02 * i, 0]))) for i in range(10)])
    assert error.ate_rmse_m == 0.0
    assert error.rpe_rotation_rmse_rad == pytest.approx(0.02, abs=1e-12)


def test_umeyama_of_mirrored_points_is_no_reflection():
    x = rng.normal(size=(10, 3))
    R, _ = umeyama(x, x * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_trajectory_error_skips_lost_and_unknown_poses():
    true: list = walk(6)
    estimated = [Pose(T) for T in true]
    estimated[2] = Pose(exp_se3(np.array([9.0, 0, 0, 0, 0, 0])), lost=True, reason="test")
    true[5] = None
    error = evaluate(true, estimated)
    assert (error.frames, error.pairs) == (4, 2)
    assert error.ate_rmse_m < 1e-12
    assert error.rpe_rmse_m < 1e-12


def test_trajectory_error_without_pose_pairs_is_empty():
    assert evaluate([], []).metrics() == {}
    assert evaluate([None], [Pose(np.eye(4))]).metrics() == {}
    assert evaluate([np.eye(4)], [Pose(np.eye(4))]).metrics() == {"trajectory.ate_rmse_m": 0.0}
    with pytest.raises(DataError, match=r"expected equal lengths, got .* ground-truth and .* estimated poses"):
        evaluate([None], [])


def test_trajectory_errors_match_evo():
    metrics = pytest.importorskip("evo.core.metrics", reason="requires evo")
    from evo.core.trajectory import PosePath3D

    true = walk(50, seed=1)
    estimated = [T @ exp_se3(rng.normal(0, 0.05, 6)) for T in true]
    ours = evaluate(true, [Pose(T) for T in estimated])

    reference = PosePath3D(poses_se3=true)
    aligned = PosePath3D(poses_se3=estimated)
    aligned.align(reference, correct_scale=False)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((reference, aligned))
    assert ours.ate_rmse_m == pytest.approx(ate.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    for relation, value in (
        (metrics.PoseRelation.translation_part, ours.rpe_rmse_m),
        (metrics.PoseRelation.rotation_angle_rad, ours.rpe_rotation_rmse_rad),
    ):
        rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, PosePath3D(poses_se3=estimated)))
        assert value == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
