"""Tests for the registration of color to depth, based on the motion of the camera."""

from __future__ import annotations

import logging
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Camera, Float64, Frame, Pose
from framework.geometry import exp_se3, inverse, project
from framework.interfaces import SubmapChange
from framework.tracking.color_to_depth import ColorToDepth, register
from tests.framework.tracking.test_color_delay import delayed_frames
from tests.support.scenes.analytic_scene import CAMERA, Scene

SCENE = Scene([(np.array([0.0, 0.0, -1.0]), -2.0)], [(np.array([0.1, 0.0, 1.3]), 0.3)])


def moving(t: float) -> Float64:
    """Return the pose of a camera with a constant velocity of 0.3 m/s and 0.8 rad/s."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.3 * t, 0.7 * t, 0.2 * t]).as_matrix()
    T[:3, 3] = [0.3 * t, 0, 0]
    return T


def frame_at(t: float, delay: float, index: int = 0) -> Frame:
    """Return a frame whose color is captured `delay` s after depth."""
    depth, _, _ = SCENE.render(CAMERA, moving(t))
    _, color, _ = SCENE.render(CAMERA, moving(t + delay))
    return Frame(index, t, color, depth, CAMERA)


def error(frame: Frame, expected: np.ndarray) -> float:
    """Return the mean color difference, gray levels. The border is excluded, because color is missing there."""
    inner = np.s_[12:-12, 12:-12]
    return float(np.abs(frame.color[inner].astype(float) - expected[inner]).mean())


@pytest.mark.parametrize("delay", [-0.03, 0.02, 0.04])
def test_color_to_depth_registers_color_at_constant_velocity(delay: float) -> None:
    registration = ColorToDepth(delay)
    frames = [frame_at(k / 30, delay, k) for k in range(3)]
    for frame in frames[:2]:
        registration.tracked(frame, Pose(moving(frame.timestamp)))
    _, expected, _ = SCENE.render(CAMERA, moving(frames[2].timestamp))
    predicted = registration.predicted(frames[2])
    found = registration.tracked(frames[2], Pose(moving(frames[2].timestamp)))
    before = error(frames[2], expected)
    assert before > 3
    assert error(predicted, expected) < before / 5
    assert error(found.frame, expected) < before / 5
    assert found.frame.depth is frames[2].depth
    np.testing.assert_allclose(found.T_world_color, moving(frames[2].timestamp + delay), atol=2e-4)


def test_color_to_depth_pixels_refer_to_color_image() -> None:
    delay = 0.04
    registration = ColorToDepth(delay)
    for k in range(3):
        frame = frame_at(k / 30, delay, k)
        found = registration.tracked(frame, Pose(moving(k / 30)))
    assert found.color_pixels is not None
    depth, _, _ = SCENE.render(CAMERA, moving(2 / 30))
    T_color_depth = inverse(moving(2 / 30 + delay)) @ moving(2 / 30)
    v, u = 60, 40
    point = depth[v, u] * np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1])
    x, y, z = T_color_depth[:3, :3] @ point + T_color_depth[:3, 3]
    expected = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
    row, column = divmod(int(found.color_pixels[v, u]), CAMERA.width)
    assert abs(column - expected[0]) < 0.6
    assert abs(row - expected[1]) < 0.6


def test_color_to_depth_timestamps_add_to_delay() -> None:
    """Color is captured 12 ms after depth: the timestamps differ by -8 ms, and the delay is 20 ms."""
    registration = ColorToDepth(0.02)
    for k in range(3):
        frame = replace(frame_at(k / 30, 0.012, k), color_timestamp=k / 30 - 0.008, depth_timestamp=k / 30)
        found = registration.tracked(frame, Pose(moving(k / 30)))
    np.testing.assert_allclose(found.T_world_color, moving(2 / 30 + 0.012), atol=2e-4)


def test_color_to_depth_without_delay_keeps_frame() -> None:
    registration = ColorToDepth(0.0)
    for k in range(3):
        frame = frame_at(k / 30, 0, k)
        assert registration.predicted(frame) is frame
        found = registration.tracked(frame, Pose(moving(k / 30)))
        assert found.frame is frame
        assert found.color_pixels is None
        np.testing.assert_array_equal(found.T_world_color, moving(k / 30))


def test_color_to_depth_lost_frame_restarts_velocity() -> None:
    registration = ColorToDepth(0.04)
    for k in range(3):
        registration.tracked(frame_at(k / 30, 0.04, k), Pose(moving(k / 30)))
    lost = frame_at(3 / 30, 0.04, 3)
    assert registration.tracked(lost, Pose(moving(2 / 30), lost=True)).frame is lost
    later = frame_at(4 / 30, 0.04, 4)
    assert registration.predicted(later) is later
    assert registration.tracked(later, Pose(moving(4 / 30))).frame is later


def test_color_to_depth_slow_camera_keeps_frame() -> None:
    registration = ColorToDepth(0.04)
    for k in range(3):
        frame = replace(frame_at(0, 0, k), timestamp=k / 30)
        found = registration.tracked(frame, Pose(moving(1e-4 * k)))
        assert found.frame is frame


def test_color_to_depth_estimated_delay_is_used_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    registration = ColorToDepth(None)
    with caplog.at_level(logging.INFO):
        displaced = []
        for frame, pose in delayed_frames(0.03):
            found = registration.tracked(frame, Pose(pose))
            displaced.append(registration.displaced_before)
    assert registration.delay == pytest.approx(0.03, abs=0.002)
    assert found.color_pixels is not None
    assert sum(displaced) == 1  # True only when the estimate is used for the first time
    assert len(caplog.messages) == 1
    assert "ms after depth at equal timestamps" in caplog.messages[0]


def test_color_to_depth_short_delay_does_not_displace_colors() -> None:
    registration = ColorToDepth(None)
    for frame, pose in delayed_frames(0.0):
        registration.tracked(frame, Pose(pose))
        assert not registration.displaced_before
    assert registration.estimate is not None
    assert registration.estimate.known


def test_color_to_depth_correction_keeps_motion() -> None:
    plain, corrected = ColorToDepth(None), ColorToDepth(None)
    change = SubmapChange({1: exp_se3(np.array([0.5, -0.2, 0.1, 0.3, 0.9, -0.4]))})
    T_new_old = np.eye(4)
    for k, (frame, T_world_camera) in enumerate(delayed_frames(0.03, count=36)):
        expected = plain.tracked(frame, Pose(T_world_camera))
        found = corrected.tracked(frame, Pose(T_new_old @ T_world_camera))
        np.testing.assert_allclose(found.T_world_color, T_new_old @ expected.T_world_color, atol=1e-5)
        assert (found.color_pixels is None) == (expected.color_pixels is None)
        if k % 10 == 9:
            corrected.correct(change, submap=1)
            T_new_old = change.moved(1, T_new_old)
    assert found.color_pixels is not None
    assert corrected.delay == pytest.approx(plain.delay, abs=1e-5)
    assert corrected.estimate is not None
    assert plain.estimate is not None
    assert corrected.estimate.frames == plain.estimate.frames


def random_frame(seed: int) -> Frame:
    """Return a frame with random colors and depths."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (30, 40, 3), np.uint8)
    return Frame(0, 0.0, color, rng.uniform(1, 2, (30, 40)).astype(np.float32), Camera(40, 30, 35.0, 36.0, 19.5, 14.0))


def test_registration_identity_returns_same_image() -> None:
    frame = random_frame(0)
    frame.depth[3, 4] = 0
    color, pixels = register(frame, np.eye(4))
    np.testing.assert_array_equal(color, frame.color)
    expected = np.arange(1200, dtype=np.int32).reshape(30, 40)
    expected[3, 4] = -1
    np.testing.assert_array_equal(pixels, expected)


def test_registration_without_depth_returns_image() -> None:
    frame = random_frame(0)
    frame.depth[:] = 0
    color, pixels = register(frame, np.eye(4))
    np.testing.assert_array_equal(color, frame.color)
    assert (pixels == -1).all()


def test_registration_equals_reference() -> None:
    frame = random_frame(1)
    camera, color = frame.camera, frame.color
    T_color_depth = exp_se3(np.array([0.02, -0.01, 0.03, 0.03, -0.05, 0.02]))
    registered, pixels = register(frame, T_color_depth)
    inside = 0
    for v in range(30):
        for u in range(40):
            x = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0]) * frame.depth[v, u]
            column, row = project(camera, (T_color_depth[:3, :3] @ x + T_color_depth[:3, 3])[None])[0]
            if not (0 <= column < 39 and 0 <= row < 29):
                continue
            inside += 1
            assert pixels[v, u] == round(row) * 40 + round(column)
            np.testing.assert_array_equal(registered[v, u], color[round(row), round(column)])
    assert inside > 900


def test_predicted_color_damps_pose_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose error displaces the next color image, which causes another pose error. The errors must not increase."""
    registration = ColorToDepth(0.04)
    errors = [0.0, 0.002]  # m, along the x axis of the camera
    for k in range(30):
        frame = frame_at(k / 30, 0.04, k)
        if k == len(errors):
            with monkeypatch.context() as patch:
                spy = Mock(wraps=register)
                patch.setattr("framework.tracking.color_to_depth.register", spy)
                registration.predicted(frame)
            T_depth_color = inverse(moving(k / 30)) @ moving(k / 30 + 0.04)
            errors.append(float(T_depth_color[0, 3] - inverse(spy.call_args.args[1])[0, 3]))
        T_world_camera = moving(k / 30)
        T_world_camera[:3, 3] += T_world_camera[:3, 0] * errors[k]
        registration.tracked(frame, Pose(T_world_camera))
    assert max(map(abs, errors[-5:])) < 1e-3
