"""Tests for the alignment of ground truth with a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import ReferenceTrajectory, SceneTruth
from framework.errors import DataError
from framework.evaluation.trajectory import align
from framework.evaluation.truth_alignment import in_map_world
from framework.geometry import exp_se3, inverse, rotation_angle, transform

T_MAP_TRUTH = exp_se3(np.array([3.0, -2.0, 1.0, 0.5, 1.0, -0.7]))
TIMES = 1305031102.1753 + np.arange(6) / 30  # Unix time, which has a precision of 2e-7 s as a double


def path(turns_only: bool = False) -> np.ndarray:
    rng = np.random.default_rng(1)
    twists = rng.normal(0, 0.3, (len(TIMES), 6)) * ([0, 0, 0, 1, 1, 1] if turns_only else 1)
    return np.array([exp_se3(twist) for twist in twists])


def truth(given: bool, poses: np.ndarray) -> SceneTruth:
    points = np.random.default_rng(2).normal(size=(50, 3)).astype(np.float32)
    return SceneTruth(points, np.ones(50, np.int32), {1: "cup"}, None, ReferenceTrajectory(TIMES, poses, given))


@pytest.mark.parametrize("turns_only", [False, True])
def test_align_returns_motion_between_trajectories(turns_only: bool) -> None:
    """If the camera only rotates, its positions alone do not determine the alignment."""
    poses = path(turns_only)
    np.testing.assert_allclose(align(poses, T_MAP_TRUTH @ poses), T_MAP_TRUTH, atol=1e-12)
    np.testing.assert_allclose(align(poses[:1], T_MAP_TRUTH @ poses[:1]), T_MAP_TRUTH, atol=1e-12)


def test_align_is_least_squares_solution() -> None:
    """The cost is the sum of squared distances of the positions and of points on the camera axes."""
    P, rng = path(), np.random.default_rng(3)
    Q = np.array([T_MAP_TRUTH @ pose @ exp_se3(rng.normal(0, 0.05, 6)) for pose in P])
    corners = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], np.float64)

    def cost(T: np.ndarray) -> float:
        return sum(
            float(np.sum((q @ corner - T @ p @ corner) ** 2)) for p, q in zip(P, Q, strict=True) for corner in corners
        )

    best = align(P, Q)
    assert rotation_angle((inverse(best) @ T_MAP_TRUTH)[:3, :3]) > 1e-3
    for _ in range(50):
        assert cost(best) < cost(exp_se3(rng.normal(0, 0.01, 6)) @ best)


@pytest.mark.parametrize("given", [True, False])
def test_in_map_world_aligns_truth_to_map_trajectory(given: bool) -> None:
    labeled = truth(given, path())
    some = [1, 2, 5]  # the others are lost
    moved = in_map_world(labeled, TIMES[some] + 1e-7, (T_MAP_TRUTH @ path())[some])
    np.testing.assert_allclose(moved.points_world, transform(T_MAP_TRUTH, labeled.points_world), atol=1e-5)
    assert moved.trajectory is None
    assert all(getattr(moved, name) is getattr(labeled, name) for name in ("instance_ids", "class_names", "classes"))


def test_in_map_world_given_first_pose_keeps_truth() -> None:
    labeled = truth(True, path())
    drifted = np.array([pose @ exp_se3(np.full(6, 0.02 * k)) for k, pose in enumerate(path())])
    assert in_map_world(labeled, TIMES, drifted) is labeled
    assert in_map_world(replace(labeled, trajectory=None), TIMES, drifted).points_world is labeled.points_world
    assert in_map_world(truth(False, path()), TIMES, drifted).trajectory is None


def test_in_map_world_without_given_first_pose_aligns_truth() -> None:
    """In this case, the tracker begins with the identity instead of the true pose."""
    labeled = truth(True, path())
    labeled = replace(labeled, trajectory=ReferenceTrajectory(TIMES[1:], path()[1:], given=True))
    T_map_truth = inverse(path()[0])
    moved = in_map_world(labeled, TIMES, T_map_truth @ path())
    np.testing.assert_allclose(moved.points_world, transform(T_map_truth, labeled.points_world), atol=1e-5)


def test_in_map_world_without_common_timestamps_raises() -> None:
    with pytest.raises(DataError, match="expected poses at the times of the"):
        in_map_world(truth(False, path()), TIMES + 0.01, path())
    with pytest.raises(DataError, match="expected poses at the times of the"):
        in_map_world(truth(False, path()), TIMES[:0], path()[:0])


def test_reference_trajectory_finds_poses_by_timestamp() -> None:
    reference = ReferenceTrajectory(TIMES, path(), given=True)
    asked = np.array([TIMES[0] - 1, TIMES[0], TIMES[2] - 5e-6, TIMES[2] + 5e-6, TIMES[5] + 1e-3])
    assert reference.at(asked).tolist() == [-1, 0, 2, 2, -1]
    assert ReferenceTrajectory(np.zeros(0), np.zeros((0, 4, 4)), given=True).at(asked).tolist() == [-1] * 5
