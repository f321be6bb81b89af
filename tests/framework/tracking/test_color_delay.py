"""Tests for the estimation of the delay between color and depth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera, Float64, Frame
from framework.tracking.color_delay import (
    BLOCKS,
    MAX_DEVIATION,
    OFFSET_DEVIATION,
    TESTED_DELAYS,
    UNKNOWN,
    DelayEstimator,
    edge_points,
    is_usable,
    poses_at,
    regress,
)
from framework.tracking.color_delay_kernels import find_edges, mean_gradients
from tests.support.scenes.analytic_scene import Scene

CAMERA = Camera(240, 180, 197.0, 197.0, 119.5, 89.5)
WALL = (np.array([0.0, 0.0, -1.0]), -3.0)
SPHERES = [(np.array([x, y, 1.5 + 0.2 * k]), 0.22) for k, (x, y) in enumerate([(-0.7, -0.3), (0.0, 0.35), (0.7, -0.2)])]
PALETTE = np.array([[0, 0, 0], [60, 60, 60], [230, 230, 230], [250, 180, 180], [180, 250, 250]], np.uint8)


def turning(t: float) -> Float64:
    """Return the pose of a camera that rotates back and forth, at time `t`, s."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.12 * np.sin(5 * t), 0.2 * np.sin(4 * t + 1), 0.05 * np.sin(3 * t)]).as_matrix()
    T[:3, 3] = [0.05 * np.sin(2 * t), 0, 0]
    return T


def delayed_frames(delay: float, count: int = 60, speed: float = 1.0) -> Iterator[tuple[Frame, Float64]]:
    """Yield `count` frames and their poses. Color is captured `delay` s after depth."""
    scene = Scene([WALL], SPHERES)
    for k in range(count):
        t = k / 30
        pose = turning(speed * t)
        depth, _, _ = scene.render(CAMERA, pose)
        _, _, surface = scene.render(CAMERA, turning(speed * (t + delay)))
        yield Frame(k, t, PALETTE[surface], depth, CAMERA), pose


@pytest.mark.parametrize("delay", [-0.03, 0.0, 0.015, 0.04])
def test_delay_estimator_known_delay_is_found_within_2_ms(delay: float) -> None:
    estimator = DelayEstimator()
    for frame, pose in delayed_frames(delay):
        estimator.add(frame, pose)
    assert is_usable(estimator.estimate)
    assert estimator.estimate.seconds == pytest.approx(delay, abs=0.002)
    assert abs(estimator.estimate.seconds - delay) < 4 * max(estimator.estimate.deviation, 0.0003)


def test_delay_estimator_uses_timestamps_of_both_images() -> None:
    estimator = DelayEstimator()
    for frame, pose in delayed_frames(0.02):
        late = 0.008 if frame.index % 2 else 0.012  # s, depth timestamp minus color timestamp
        stamped = Frame(
            frame.index, frame.timestamp, frame.color, frame.depth, CAMERA,
            color_timestamp=frame.timestamp - late, depth_timestamp=frame.timestamp,
        )  # fmt: skip
        estimator.add(stamped, pose)
    assert estimator.estimate.seconds == pytest.approx(0.03, abs=0.002)


def test_delay_estimator_of_static_camera_is_unknown() -> None:
    estimator = DelayEstimator()
    for frame, pose in delayed_frames(0.02, count=40, speed=0):
        estimator.add(frame, pose)
    assert estimator.estimate == UNKNOWN
    assert estimator.estimate.seconds == 0
    assert not is_usable(estimator.estimate)


def test_delay_estimator_gap_in_time_restarts_history() -> None:
    gaps, steady = DelayEstimator(), DelayEstimator()
    for frame, pose in delayed_frames(0.02, count=30):
        steady.add(frame, pose)
        pause = 10.0 * (frame.index // 5)  # s; a gap of 10 s before every fifth frame
        gaps.add(Frame(frame.index, frame.timestamp + pause, frame.color, frame.depth, CAMERA), pose)
    assert steady.estimate.frames > 0
    assert gaps.estimate == UNKNOWN


def test_regress_separates_delay_from_constant_offset() -> None:
    rng = np.random.default_rng(0)
    motion = rng.normal(0, 0.5, (80, 2))
    speed = np.hypot(*motion.T)
    shift = speed * 0.02 + motion @ [0.0015, -0.001] / speed + rng.normal(0, 0.001, 80)  # image widths
    found = regress(np.column_stack([shift / speed, motion]), start=0.0)
    assert found.seconds == pytest.approx(0.02, abs=3 * found.deviation)
    assert found.deviation < 0.002
    assert found.frames == 80


def test_regress_ignores_outliers() -> None:
    rng = np.random.default_rng(1)
    motion = rng.normal(0, 0.5, (80, 2))
    delays = 0.02 + rng.normal(0, 0.001, 80) / np.hypot(*motion.T)
    delays[::4] = rng.uniform(-0.1, 0.1, 20)
    assert regress(np.column_stack([delays, motion]), start=0.02).seconds == pytest.approx(0.02, abs=0.001)


def test_regress_constant_motion_has_deviation_of_offset() -> None:
    """At a constant rate of rotation, a constant offset and a delay have the same effect."""
    rng = np.random.default_rng(2)
    motion = np.array([0.3, 0.0]) + rng.normal(0, 0.001, (8 * BLOCKS, 2))
    delays = 0.02 + rng.normal(0, 0.001, len(motion)) / 0.3
    found = regress(np.column_stack([delays, motion]), start=0.02)
    assert found.seconds == pytest.approx(0.02, abs=found.deviation)
    assert found.deviation == pytest.approx(OFFSET_DEVIATION / 0.3, rel=0.2)
    assert found.deviation > MAX_DEVIATION


def test_poses_at_interpolates_and_extrapolates_constant_motion() -> None:
    def pose(t: float) -> Float64:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0, 0.3 * t, 0]).as_matrix()
        T[:3, 3] = [t, 2 * t, 0]
        return T

    times = np.array([0.0, 0.4, 1.0])
    at = np.array([-0.2, 0.0, 0.3, 0.4, 0.7, 1.3])
    found = poses_at(times, np.array([pose(t) for t in times]), at)
    np.testing.assert_allclose(found, [pose(t) for t in at], atol=1e-12)


def test_find_edges_returns_nearer_side_across_missing_depth() -> None:
    depth = np.full((20, 40), 2.0, np.float32)
    depth[:, :20] = 1.0
    depth[:, 20:23] = 0  # depth is missing between the surfaces
    edges = np.zeros((100, 3), np.float32)
    count = find_edges(depth, edges)
    assert count > 0
    assert (edges[:count, 0] >= 17).all()
    assert (edges[:count, 0] <= 19).all()
    assert (edges[:count, 2] == 1).all()
    assert find_edges(np.full((20, 40), 2.0, np.float32), edges) == 0


def test_edge_points_are_on_outlines_of_near_surfaces() -> None:
    scene = Scene([WALL], SPHERES[:1])
    points = edge_points(scene.frame(np.eye(4), camera=CAMERA))
    assert len(points) > 20
    assert np.abs(np.linalg.norm(points - SPHERES[0][0], axis=1) - SPHERES[0][1]).max() < 0.01


def test_mean_gradients_equal_reference() -> None:
    rng = np.random.default_rng(3)
    gradient = rng.random((60, 80), np.float32)
    points = rng.uniform([-0.5, -0.4, 1], [0.5, 0.4, 2], (50, 3)).astype(np.float32)
    transforms = np.tile(np.eye(4, dtype=np.float32)[:3], (3, 1, 1))
    transforms[1, 0, 3], transforms[2, 2, 3] = 0.3, -0.1
    fx, fy, cx, cy = (np.float32(x) for x in (130.0, 131.0, 79.5, 59.5))
    means = np.empty(3)
    mean_gradients(points, transforms, (fx, fy, cx, cy), np.float32(0.5), gradient, means)
    for T, found in zip(transforms, means, strict=True):
        values = []
        for p in points:
            x, y, z = T[:, :3] @ p + T[:, 3]
            u, v = (fx * x / z + cx + 0.5) / 2 - 0.5, (fy * y / z + cy + 0.5) / 2 - 0.5
            i, j = int(np.floor(u)), int(np.floor(v))
            if 0 <= i < 79 and 0 <= j < 59:
                a, b = u - i, v - j
                top = (1 - a) * gradient[j, i] + a * gradient[j, i + 1]
                low = (1 - a) * gradient[j + 1, i] + a * gradient[j + 1, i + 1]
                values.append((1 - b) * top + b * low)
        assert found == pytest.approx(np.mean(values), abs=1e-4)


def test_tested_delays_contain_zero() -> None:
    assert np.abs(TESTED_DELAYS).min() < 1e-12
