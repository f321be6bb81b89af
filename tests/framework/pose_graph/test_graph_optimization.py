"""Tests for the pose graph, against exact solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.geometry import exp_se3, inverse, pose_distance
from framework.pose_graph.graph_optimization import LOOP_NOISE, AnchorGraph, GraphEdge, optimize

SIDE = exp_se3(np.array([0, 0, 0, 0, np.pi / 2, 0.0])) @ exp_se3(np.array([3.0, 0, 0, 0, 0, 0]))  # turn, then walk
TURN = 0.02  # rad, drift of the camera along each side
DRIFT = (0.06, 0.03)  # m and rad, standard deviations of this drift


def square(turn: float = TURN) -> tuple[list[np.ndarray], list[np.ndarray], list[GraphEdge]]:
    """Return true and tracked anchors of a square whose last anchor is at the first one, and the tracked edges."""
    tracked = SIDE @ exp_se3(np.array([0, 0, 0, 0, turn, 0.0]))
    true, poses = [np.eye(4)], [np.eye(4)]
    for _ in range(4):
        true.append(true[-1] @ SIDE)
        poses.append(poses[-1] @ tracked)
    covariance = np.diag(np.repeat(DRIFT, 3) ** 2)
    return true, poses, [GraphEdge.tracked(k, k + 1, tracked, covariance) for k in range(4)]


def test_optimize_square_with_equal_drift_distributes_it() -> None:
    """By symmetry, each side gets the same part of the rotation, and the loop its part by the variances."""
    true, poses, edges = square()
    poses, kept = optimize(poses, [*edges, GraphEdge.loop(0, 4, np.eye(4))])
    sides, closing = 4 * DRIFT[1] ** 2, LOOP_NOISE[1] ** 2
    remaining = 4 * TURN * closing / (sides + closing)  # rad, rotation between the first and the last anchor
    assert pose_distance(poses[0], np.eye(4)) == 0
    assert pose_distance(poses[4], true[4]) == pytest.approx(remaining, rel=0.1)
    assert max(pose_distance(*pair) for pair in zip(true, poses, strict=True)) < 0.01
    assert len(kept) == 5


def test_optimize_moves_the_least_certain_edge_in_its_least_certain_direction() -> None:
    """The drift of a straight path is removed where the covariance allows it."""
    step = exp_se3(np.array([3.0, 0, 0, 0, 0, 0]))
    certain, uncertain = (np.diag([x**2, 1e-6, 1e-6, 1e-8, 1e-8, 1e-8]) for x in (1e-3, 1.0))
    edges = [GraphEdge.tracked(k, k + 1, step, uncertain if k == 1 else certain) for k in range(3)]
    poses, _ = optimize([exp_se3(np.array([3.0 * k, 0, 0, 0, 0, 0])) for k in range(4)], [
        *edges, GraphEdge.loop(0, 3, exp_se3(np.array([8.9, 0, 0, 0, 0, 0]))),
    ])  # fmt: skip
    assert np.array(poses)[:, :3, 3] == pytest.approx(
        np.array([[0, 0, 0], [3, 0, 0], [5.9, 0, 0], [8.9, 0, 0]]), abs=2e-3
    )


@pytest.mark.parametrize("accuracy", [1.0, 100.0])
def test_optimize_contradicting_loop_is_removed(accuracy: float) -> None:
    true, poses, edges = square(TURN / accuracy)
    edges = [replace(edge, information=accuracy**2 * edge.information) for edge in edges]
    wrong = GraphEdge.loop(1, 4, inverse(true[1]) @ true[4] @ exp_se3(np.array([0.8, 0, 0, 0, 0.3, 0])))
    nearly = exp_se3(np.array([0.002, 0, 0, 0, 0, 0]))
    right = [GraphEdge.loop(0, 4, np.eye(4)), GraphEdge.loop(0, 4, nearly), GraphEdge.loop(0, 3, true[3])]
    poses, kept = optimize(poses, [*edges, right[0], wrong, *right[1:]])
    assert [edge for edge in kept if edge.is_loop] == right
    assert max(pose_distance(*pair) for pair in zip(true, poses, strict=True)) < 0.01


def test_optimize_large_drift_keeps_correct_loops() -> None:
    true, poses, edges = square(0.06)
    assert np.linalg.norm(poses[4][:3, 3]) > 0.3
    poses, kept = optimize(poses, [*edges, GraphEdge.loop(0, 4, np.eye(4)), GraphEdge.loop(0, 3, true[3])])
    assert len(kept) == 6
    assert max(pose_distance(*pair) for pair in zip(true, poses, strict=True)) < 0.03


def test_optimize_repeated_is_bit_identical() -> None:
    _, poses, edges = square()
    runs = [optimize(poses, [*edges, GraphEdge.loop(0, 4, np.eye(4))]).poses for _ in range(3)]
    assert len({np.stack(run).tobytes() for run in runs}) == 1


def test_path_lengths_are_shortened_by_loops() -> None:
    graph = AnchorGraph(square()[2])
    assert graph.path_lengths(4) == pytest.approx({4: 0, 3: 3, 2: 6, 1: 9, 0: 12})
    graph.edges.append(GraphEdge.loop(0, 4, np.eye(4)))
    assert graph.path_lengths(4) == pytest.approx({4: 0, 3: 3, 2: 6, 1: 3, 0: 0})


def test_extended_poses_follow_tracked_motion() -> None:
    _, poses, edges = square()
    moved = [inverse(poses[1]) @ T for T in poses]
    found = AnchorGraph([*edges, GraphEdge.loop(4, 0, np.eye(4))]).extended(moved[:2])
    assert max(pose_distance(*pair) for pair in zip(moved, found, strict=True)) < 1e-9
