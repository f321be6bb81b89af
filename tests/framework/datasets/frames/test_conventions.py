"""Tests for conventions of poses, units and image pairs that differ from the dataset format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Float64
from framework.datasets.frames.conventions import CameraAxes, DepthReading, PoseKind, PoseReading, QuaternionOrder
from framework.datasets.frames.sequence_reader import RecordedFrame, StoredImages, delay_depth, delay_poses
from framework.datasets.tum_rgbd import TumRgbd
from framework.errors import ConfigError, FrameError
from framework.geometry import inverse


def some_pose(seed: int) -> Float64:
    chosen = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = chosen.normal(size=3)
    return T


@pytest.mark.parametrize("seed", range(5))
def test_pose_reading_recovers_original_pose(seed: int) -> None:
    T_world_camera = some_pose(seed)
    np.testing.assert_array_equal(PoseReading().pose(T_world_camera), T_world_camera)
    inverted = PoseReading(pose_kind=PoseKind.T_CAMERA_WORLD)
    np.testing.assert_allclose(inverted.pose(inverse(T_world_camera)), T_world_camera, atol=1e-12)
    in_mm = T_world_camera.copy()
    in_mm[:3, 3] *= 1000
    np.testing.assert_allclose(PoseReading(pose_unit=0.001).pose(in_mm), T_world_camera, atol=1e-12)
    x, y, z, w = Rotation.from_matrix(T_world_camera[:3, :3]).as_quat()
    misread = T_world_camera.copy()
    misread[:3, :3] = Rotation.from_quat((w, x, y, z)).as_matrix()  # the file stores w x y z, which is read as x y z w
    scalar_first = PoseReading(quaternion_order=QuaternionOrder.WXYZ)
    np.testing.assert_allclose(scalar_first.pose(misread), T_world_camera, atol=1e-12)


def test_camera_axes_match_system_conventions() -> None:
    """The expected vectors are right, down and forward of the image in the axes of each system."""
    right, below, ahead = np.eye(3)
    for axes, expected in {
        CameraAxes.OPENCV: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        CameraAxes.OPENGL: ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
        CameraAxes.ROS: ((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    }.items():
        np.testing.assert_array_equal([axes.R_axes_camera @ v for v in (right, below, ahead)], expected)
        assert np.linalg.det(axes.R_axes_camera) == pytest.approx(1)
        T_world_axes = some_pose(3)
        T_world_camera = PoseReading(camera_axes=axes).pose(T_world_axes)
        np.testing.assert_allclose(T_world_camera[:3, :3] @ ahead, T_world_axes[:3, :3] @ np.array(expected[2]))
        np.testing.assert_array_equal(T_world_camera[:3, 3], T_world_axes[:3, 3])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"depth_scale": 0.5}, "dataset.depth_scale"),
        ({"depth_scale": -1.0}, "depth_scale"),
        ({"depth_delay": 1001}, "delay"),
    ],
)
def test_conventions_invalid_parameter_raises(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        DepthReading(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="pose_unit"):
        PoseReading(pose_unit=0.0)
    with pytest.raises(ConfigError, match="pose_delay"):
        PoseReading(pose_delay=-1001)


def images(k: int) -> StoredImages:
    """Return 2x2 images in which all pixels have the value k."""
    color, depth = np.full((2, 2, 3), k, np.uint8), np.full((2, 2), k, np.uint16)
    return StoredImages(f"color {k}", f"depth {k}", lambda: color, lambda: depth)


@pytest.mark.parametrize("delay", [-2, 0, 1])
def test_depth_delay_pairs_color_with_matching_depth(delay: int) -> None:
    frames = delay_depth([RecordedFrame(images(k), k / 30) for k in range(5)], delay)
    for k, frame in enumerate(frames):
        if 0 <= k + delay < 5:
            assert not frame.error
            assert (frame.images.color()[0, 0, 0], frame.images.depth()[0, 0]) == (k, k + delay)
            assert (frame.images.color_name, frame.images.depth_name) == (f"color {k}", f"depth {k + delay}")
            assert frame.timestamp == k / 30
        else:
            assert f"offset of {delay} frames" in frame.error


@pytest.mark.parametrize("delay", [-2, 0, 1])
def test_pose_delay_pairs_images_with_matching_pose(delay: int) -> None:
    stored = [RecordedFrame(images(k), k / 30, some_pose(k), up=np.array([0.0, -1.0, 0.0])) for k in range(5)]
    stored[3] = RecordedFrame(images(3), 3 / 30, error="line 3 is no pose")
    for k, frame in enumerate(delay_poses(stored, delay)):
        assert (frame.images.color()[0, 0, 0], frame.timestamp) == (k, k / 30)
        if not 0 <= k + delay < 5:
            assert frame.error == f"expected a pose at an offset of {delay} frames, got none"
            assert frame.T_world_camera is None
        elif 3 in (k, k + delay):
            assert frame.error == "line 3 is no pose"
        else:
            assert not frame.error
            np.testing.assert_array_equal(frame.T_world_camera, some_pose(k + delay))
            assert frame.up is stored[k].up


def test_conventions_are_applied_when_recording_is_read() -> None:
    desk = {"root": Path("data/desk"), "scene": "rgbd_dataset_freiburg1_rpy"}
    plain = TumRgbd(**desk)  # type: ignore[arg-type]
    meant = TumRgbd(
        **desk,  # type: ignore[arg-type]
        pose_reading=PoseReading(PoseKind.T_CAMERA_WORLD, CameraAxes.OPENGL, pose_delay=2),
        depth_reading=DepthReading(depth_scale=10_000, depth_delay=1),
    )
    first, then = plain[2], meant[0]
    assert first.T_world_camera is not None
    assert then.T_world_camera is not None
    np.testing.assert_allclose(then.T_world_camera, inverse(first.T_world_camera) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(then.color, plain[0].color)
    np.testing.assert_allclose(then.depth, plain[1].depth / 2, rtol=1e-6)
    with pytest.raises(FrameError, match="expected a pose at an offset of 2 frames, got none"):
        meant[len(meant) - 1]
