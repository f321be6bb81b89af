"""Tests for the registration of keyframes, with exact points and in a textured room."""

from __future__ import annotations

import numpy as np
import pytest

from framework.data import Float64
from framework.editing.keyframe_registration import MAX_ERROR, MIN_INLIERS, PointMatches, match_keyframes, register
from framework.geometry import exp_se3, inverse, pose_distance, transform
from framework.tracking.keyframes import Keyframe, Keyframes
from tests.support.scenes.papered_room import papered_frame

T_A_B = exp_se3(np.array([2.0, -0.7, 1.1, 0.4, -1.9, 0.3]))


def matches_of(T_a_b: Float64, inliers: int, outliers: int, seed: int, noise: float = 0.005) -> PointMatches:
    """Return random matches of one pair of keyframes."""
    rng = np.random.default_rng(seed)
    points_b = rng.uniform(-2, 2, (inliers + outliers, 3))
    points_a = transform(T_a_b, points_b) + rng.normal(0, noise, points_b.shape)
    points_a[inliers:] = rng.uniform(-3, 3, (outliers, 3))
    return PointMatches(points_a, points_b, [0, inliers + outliers])


def joined(*pairs: PointMatches) -> PointMatches:
    starts = np.cumsum([0, *(len(one.points_a) for one in pairs)]).tolist()
    points_a, points_b = (np.concatenate([one[k] for one in pairs]) for k in (0, 1))
    return PointMatches(points_a, points_b, starts)


def keyframes(yaws: list[float], T_other_world: Float64, paper: int = 0) -> list[Keyframe]:
    """Return keyframes of the papered room in the world frame `other`."""
    found = Keyframes()
    for yaw in yaws:
        T_world_camera = exp_se3(np.array([0, 0, 0, 0, yaw, 0]))
        found.add(papered_frame(T_world_camera, paper=paper), T_other_world @ T_world_camera)
    return [*found]


def test_registration_ignores_outliers() -> None:
    found = register(joined(*(matches_of(T_A_B, 30, 60, seed) for seed in range(3))))
    assert found is not None
    assert pose_distance(found.T_a_b, T_A_B) < 0.005
    assert 90 <= len(found.matches.points_a) <= 95
    assert found.other_inliers < 15


def test_registration_is_deterministic() -> None:
    matches = joined(*(matches_of(T_A_B, 30, 60, seed) for seed in range(3)))
    first, second = register(matches), register(matches)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.T_a_b, second.T_a_b)


def test_registration_counts_matches_of_rival() -> None:
    """Two identical rooms give two transforms."""
    T_other = exp_se3(np.array([5.0, 0, 0, 0, 0, 0])) @ T_A_B
    found = register(joined(matches_of(T_A_B, 60, 0, 0), matches_of(T_other, 50, 0, 1)))
    assert found is not None
    assert (len(found.matches.points_a), found.other_inliers) == (60, 50)


@pytest.mark.parametrize("pairs", [[], [matches_of(T_A_B, MIN_INLIERS - 10, 40, 0)], [matches_of(T_A_B, 0, 200, 0)]])
def test_registration_with_few_inliers_is_none(pairs: list[PointMatches]) -> None:
    assert register(joined(*pairs) if pairs else PointMatches(np.zeros((0, 3)), np.zeros((0, 3)), [0])) is None


def test_registration_of_room_finds_transform() -> None:
    a, b = keyframes([0.0, 0.4, 0.8, 1.2], np.eye(4)), keyframes([0.9, 1.4, 1.9], inverse(T_A_B))
    found = register(match_keyframes(a, b))
    assert found is not None
    assert pose_distance(found.T_a_b, T_A_B) < 0.02
    assert (
        np.linalg.norm(transform(found.T_a_b, found.matches.points_b) - found.matches.points_a, axis=1).max()
        <= MAX_ERROR
    )


def test_registration_of_different_rooms_is_none() -> None:
    a, b = keyframes([0.0, 0.4, 0.8], np.eye(4)), keyframes([0.0, 0.4, 0.8], np.eye(4), paper=1)
    assert register(match_keyframes(a, b)) is None
