"""Tests for the detection of a delay between poses and frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from framework.checking.matched_pairs import MatchedPair
from framework.checking.pose_delay import MAX_DELAY, PoseDelay, delayed, find_delay
from framework.checking.pose_fit import PoseFit, motion_of
from framework.data import Camera, Float64, Frame
from framework.datasets.frames.conventions import CameraAxes, PoseReading
from framework.geometry import exp_se3, inverse, project, transform

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
BLANK = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32)
FRAMES = 80
IDENTITY_FIT = (PoseFit(PoseReading(), 1.0, np.zeros(0)),)


def uneven_path() -> list[Float64]:
    """Return the poses of a camera with varying velocity."""
    chosen = np.random.default_rng(0)
    poses = [np.eye(4)]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ exp_se3(chosen.normal(scale=0.01, size=6)))
    return poses


def uniform_path() -> list[Float64]:
    """Return the poses of a camera with constant velocity."""
    return [exp_se3(k * np.array([0.01, 0.0, 0.005, 0.0, 0.01, 0.0])) for k in range(FRAMES)]


def pairs_of(true: Sequence[Float64], stored: Sequence[Float64 | None], noise: float = 0.0) -> list[MatchedPair]:
    """Return matched pairs of frames with stored poses. `noise` is the standard deviation of the matches, px."""
    pairs = []
    for k, step in ((k, step) for k in range(8, FRAMES - 24, 6) for step in (4, 8, 16)):
        chosen = np.random.default_rng(k)
        points = np.column_stack([chosen.uniform(-0.6, 0.6, (60, 2)), chosen.uniform(1.5, 3, 60)])
        T_second_first = inverse(true[k + step]) @ true[k]
        first, second = (Frame(n, n / 30, *BLANK, CAMERA, stored[n]) for n in (k, k + step))
        pixels = project(CAMERA, points).astype(np.float32)
        moved = project(CAMERA, transform(T_second_first, points)) + chosen.normal(scale=noise, size=(60, 2))
        pairs.append(
            MatchedPair(first, second, points.astype(np.float32), pixels, moved.astype(np.float32), T_second_first)
        )
    return pairs


def late(poses: Sequence[Float64], frames: int) -> list[Float64 | None]:
    """Return the poses, delayed by `frames` frames. Frames without a pose have None."""
    return [poses[k - frames] if 0 <= k - frames < len(poses) else None for k in range(len(poses))]


def found(poses: Sequence[Float64], frames: int, noise: float = 0.0) -> PoseDelay | None:
    stored = late(poses, frames)
    return find_delay(pairs_of(poses, stored, noise), stored, IDENTITY_FIT)


@pytest.mark.parametrize("frames", [-MAX_DELAY, -3, -1, 1, 2, 5, MAX_DELAY])
def test_pose_delay_is_found_without_residual_error(frames: int) -> None:
    delay = found(uneven_path(), frames)
    assert delay is not None
    assert (delay.frames, delay.alike) == (frames, ())
    assert delay.delayed_error == pytest.approx(0, abs=1e-3)
    assert delay.error > 2
    assert delay.finding(1, 0.1).setting == f"dataset.pose_delay={1 + frames}"


def test_pose_delay_of_correct_poses_and_noisy_points_is_none() -> None:
    for noise in (0.0, 1.0, 5.0):
        assert found(uneven_path(), 0, noise) is None


@pytest.mark.parametrize("frames", [-2, 1, 3])
def test_pose_delay_in_uniform_motion_is_undetectable(frames: int) -> None:
    assert found(uniform_path(), frames, 0.5) is None


def test_pose_delay_beyond_search_range_is_not_reported() -> None:
    for frames in (MAX_DELAY + 1, MAX_DELAY + 2):
        assert found(uneven_path(), frames) is None


def test_pose_delay_of_unrelated_poses_is_none() -> None:
    other = [exp_se3(np.array([0, 0, 0, 0, 0, 0.5 * k])) for k in range(FRAMES)]
    assert find_delay(pairs_of(uneven_path(), other), other, IDENTITY_FIT) is None


def test_pose_delay_skips_pairs_without_neighboring_poses() -> None:
    poses = uneven_path()
    stored = late(poses, 2)
    pairs = pairs_of(poses, stored)
    stored[40] = None
    delay = find_delay(pairs, stored, IDENTITY_FIT)
    assert delay is not None
    assert (delay.frames, delay.pairs < len(pairs)) == (2, True)
    assert find_delay(pairs, stored[:20], IDENTITY_FIT) is None
    assert find_delay(pairs, [], IDENTITY_FIT) is None


def test_pose_delay_is_found_in_best_fitting_axes() -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = uneven_path()
    stored = [None if T is None else T @ flip for T in late(poses, 3)]
    opengl = PoseFit(PoseReading(camera_axes=CameraAxes.OPENGL), 1.0, np.zeros(0))
    delay = find_delay(pairs_of(poses, stored), stored, (*IDENTITY_FIT, opengl))
    assert delay is not None
    assert delay.frames == 3


def test_delayed_returns_pairs_with_matching_poses() -> None:
    poses = uneven_path()
    stored = late(poses, -2)
    for pair in pairs_of(poses, stored):
        meant = delayed(pair, stored, -2)
        np.testing.assert_allclose(motion_of(meant, PoseReading()), pair.T_second_first, atol=1e-12)
    assert delayed(pairs_of(poses, stored)[0], stored, -20).first.T_world_camera is None
