"""Import of the bags of a small room, and checks of the imported folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.data import Camera
from framework.datasets.rgbd_folder import RgbdFolder
from framework.geometry import exp_se3, inverse
from framework.importing.bags.ros_topics import BagOptions, Topics
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from tests.support.recordings.phone_exports import ROOM, T_COLOR_DEPTH
from tests.support.recordings.ros_bags import (
    COUNT,
    T_CAMERA_ROS,
    BagWriter,
    millimeters,
    seen,
    time_of,
)
from tests.support.scenes.corner_room import look, pose_at

KINDS = {"ros1.bag": True, "ros2_folder": False, "mcap_folder": False}
DEPTH_CAMERA = Camera(424, 240, 210.0, 210.0, 211.0, 119.0)


def check_room(folder: Path, posed: bool = True, within: float = 2e-3, holes: float = 0.0) -> RgbdFolder:
    sequence = RgbdFolder(folder)
    assert (sequence.camera, len(sequence)) == (ROOM, COUNT)
    for k, frame in enumerate(sequence):
        color, depth = seen(k)
        if posed:
            assert frame.timestamp == pytest.approx(time_of(k), abs=1e-6)
            np.testing.assert_allclose(frame.T_world_camera, pose_at(k), atol=1e-6)
        assert np.abs(frame.color.astype(int) - color).mean() < 4
        read = frame.depth > 0
        assert read.mean() >= 1 - holes
        assert np.median(np.abs(frame.depth - depth)[read]) < within
        assert (np.abs(frame.depth - depth)[read] > 0.03).mean() < 0.05
    return sequence


def imported(path: Path, out: Path, **topics: str) -> list[str]:
    return write_folder(open_source(path, Topics(**topics)), out, Writing()).errors


def add_poses(bag: BagWriter, topic: str = "/pose") -> None:
    for k in range(COUNT):
        bag.add_pose(time_of(k), topic, pose_at(k))


def imported_with(path: Path, out: Path, **options: Any) -> list[str]:
    return write_folder(open_source(path, None, BagOptions(**options)), out, Writing()).errors


OPTICAL, DEPTH_FRAME = "camera_color_optical_frame", "camera_depth_optical_frame"


def add_separate_depth(
    bag: BagWriter, topic: str = "/camera/depth/image_rect_raw", info: bool = True, camera: Camera = DEPTH_CAMERA
) -> None:
    """Add color, and depth of another camera, as realsense2_camera without align_depth does."""
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/color/image_raw", seen(k)[0], "rgb8")
        depth = look(camera, pose_at(k) @ T_COLOR_DEPTH)[0]
        bag.add_image(time_of(k), topic, millimeters(depth), "16UC1", frame_id=DEPTH_FRAME)
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    if info:
        bag.add_camera(time_of(0), f"{topic.rpartition('/')[0]}/camera_info", camera)


T_BASE_CAMERA = (
    exp_se3(np.array([0.2, -0.1, 0.5, 0, 0, 0])) @ T_CAMERA_ROS.T
)  # the camera looks along the x axis of the base


def add_odometry_of_base(bag: BagWriter) -> None:
    for k in range(COUNT + 1):
        bag.add_odometry(time_of(k), "/odom", pose_at(k) @ inverse(T_BASE_CAMERA), "base_link")
