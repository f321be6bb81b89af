"""Tests for camera poses in ROS bags, from topics of other frames and from /tf."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.geometry import exp_se3, inverse
from framework.importing.bags.camera_poses import ROS_AXES
from framework.importing.formats import open_source
from tests.support.recordings.imported_bags import (
    DEPTH_FRAME,
    OPTICAL,
    T_BASE_CAMERA,
    add_odometry_of_base,
    add_poses,
    add_separate_depth,
    check_room,
    imported,
    imported_with,
)
from tests.support.recordings.phone_exports import T_COLOR_DEPTH
from tests.support.recordings.ros_bags import (
    COUNT,
    START,
    T_CAMERA_ROS,
    BagWriter,
    add_camera_of_ros,
    time_of,
)
from tests.support.scenes.corner_room import pose_at


def check_poses(bag: BagWriter, path: Path, out: Path, **options: Any) -> None:
    assert not imported_with(bag.write(path), out, **options)
    check_room(out)


@pytest.mark.parametrize("layout", ["direct", "mast", "inverse", "tf", "moving mast"])
def test_ros_bag_odometry_of_base_becomes_camera_poses(tmp_path: Path, layout: str) -> None:
    bag = BagWriter(ros1=layout == "tf")
    add_camera_of_ros(bag)
    T_base_mast = exp_se3(np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3]))
    if layout == "moving mast":
        add_odometry_of_base(bag)
        for k in range(COUNT + 1):
            T_mast = exp_se3(np.array([0, 0, 0.01 * k, 0, 0, 0.1 * k]))
            bag.add_tf(time_of(k), ("base_link", "mast", T_mast))
        bag.add_static(("mast", OPTICAL, T_BASE_CAMERA))
        bag.messages = [entry for entry in bag.messages if entry[1] != "/odom"]
        for k in range(COUNT):
            T_mast = exp_se3(np.array([0, 0, 0.01 * k, 0, 0, 0.1 * k]))
            bag.add_odometry(time_of(k), "/odom", pose_at(k) @ inverse(T_mast @ T_BASE_CAMERA), "base_link")
    else:
        add_odometry_of_base(bag)
    if layout == "direct":
        bag.add_static(("base_link", OPTICAL, T_BASE_CAMERA))
    elif layout == "inverse":
        bag.add_static((OPTICAL, "base_link", inverse(T_BASE_CAMERA)))
    elif layout == "mast":
        T_mast_camera = inverse(T_base_mast) @ T_BASE_CAMERA
        bag.add_static(("base_link", "mast", T_base_mast), ("mast", OPTICAL, T_mast_camera))
    elif layout == "tf":
        for n in range(3):
            bag.add_tf(time_of(0) + 0.05 * n, ("base_link", OPTICAL, T_BASE_CAMERA))
    check_poses(bag, tmp_path / ("a.bag" if bag.ros1 else "bag"), tmp_path / "out")


def test_ros_bag_odometry_of_unconnected_base_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_odometry_of_base(bag)
    path = bag.write(tmp_path / "bag")
    expected = (
        "expected a transform from 'base_link' to the camera 'camera_color_optical_frame' on /tf_static, got none"
    )
    with pytest.raises(DataError, match=f"{expected}; set --camera-pose .* or --poses none"):
        open_source(path)


def test_ros_bag_camera_pose_option_is_applied(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_odometry(time_of(k), "/odom", pose_at(k) @ T_CAMERA_ROS, "base_link")
    check_poses(bag, tmp_path / "bag", tmp_path / "out", camera_pose=ROS_AXES)


@pytest.mark.parametrize("layout", ["map", "map and odom", "slow map", "world", "t265", "ros1"])
def test_ros_bag_poses_on_tf_are_imported(tmp_path: Path, layout: str) -> None:
    bag = BagWriter(ros1=layout == "ros1")
    add_camera_of_ros(bag)
    bag.add_static(("base_link", OPTICAL, T_BASE_CAMERA))
    T_map_odom = exp_se3(np.array([1.0, 2.0, 0, 0, 0, 0.5])) if layout in ("map and odom", "slow map") else np.eye(4)
    root = {"world": "/world", "map and odom": "odom", "slow map": "odom", "t265": "camera_odom_frame"}.get(
        layout, "map"
    )
    for k in range(-1, COUNT + 1):
        bag.add_tf(START + k / 30, (root, "base_link", inverse(T_map_odom) @ pose_at(k) @ inverse(T_BASE_CAMERA)))
    if layout == "map and odom":
        for n in range(20):
            bag.add_tf(START - 0.1 + 0.02 * n, ("map", "odom", T_map_odom))
    if layout == "slow map":
        for n in (-1, 1):
            bag.add_tf(START + n, ("map", "odom", T_map_odom))
    check_poses(bag, tmp_path / ("a.bag" if bag.ros1 else "bag"), tmp_path / "out")


def add_camera_path(bag: BagWriter, topic: str) -> None:
    for n in range(1, COUNT + 1):
        bag.add_path(time_of(n - 1), topic, [(time_of(k), pose_at(k)) for k in range(n)])


POSE_TOPICS: dict[str, Callable[[BagWriter, int], None]] = {
    "/rtabmap/localization_pose": lambda bag, k: bag.add_pose_with_covariance(
        time_of(k), "/rtabmap/localization_pose", pose_at(k)
    ),
    "/vicon/camera": lambda bag, k: bag.add_transform_stamped(time_of(k), "/vicon/camera", pose_at(k), f"/{OPTICAL}"),
    "/mocap/robot": lambda bag, k: bag.add_transform_stamped(
        time_of(k), "/mocap/robot", pose_at(k) @ inverse(T_BASE_CAMERA), "base_link"
    ),
    "/slam/pose_stamped": lambda bag, k: bag.add_pose(time_of(k), "/slam/pose_stamped", pose_at(k)),
    "/t265/odom/sample": lambda bag, k: bag.add_odometry(
        time_of(k), "/t265/odom/sample", pose_at(k) @ inverse(T_BASE_CAMERA), "/base_link"
    ),
}


@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize("topic", POSE_TOPICS)
def test_ros_bag_kinds_of_poses_are_imported(tmp_path: Path, topic: str, ros1: bool) -> None:
    """Goals and the pose estimate of a user are not poses of the camera."""
    bag = BagWriter(ros1)
    add_camera_of_ros(bag)
    if "localization" not in topic:
        bag.add_static(("base_link", OPTICAL, T_BASE_CAMERA))
    for name in ("/goal_pose", "/move_base_simple/goal", "/mavros/setpoint_position/local"):
        bag.add_pose(time_of(1), name, np.eye(4))
    bag.add_pose_with_covariance(time_of(1), "/initialpose", np.eye(4))
    for k in range(COUNT):
        POSE_TOPICS[topic](bag, k)
    check_poses(bag, tmp_path / ("a.bag" if ros1 else "bag"), tmp_path / "out")


def test_ros_bag_goals_alone_are_no_poses(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.add_pose(time_of(1), "/goal_pose", np.eye(4))
    bag.add_pose_with_covariance(time_of(1), "/initialpose", np.eye(4))
    assert not open_source(bag.write(tmp_path / "bag")).posed


def test_ros_bag_path_is_imported_on_request(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_camera_path(bag, "/orb_slam3/path")
    path = bag.write(tmp_path / "bag")
    assert not open_source(path).posed
    assert "without poses; set --poses /orb_slam3/path if this topic has the poses of the camera" in caplog.text
    assert not imported(path, tmp_path / "out", poses="/orb_slam3/path")
    check_room(tmp_path / "out")


@pytest.mark.parametrize("on_tf", [True, False])
def test_ros_bag_localization_of_robot_is_not_camera_pose(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, on_tf: bool
) -> None:
    """AMCL publishes poses of a base frame without its name."""
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.add_static(("base_link", OPTICAL, T_BASE_CAMERA))
    for k in range(COUNT):
        T_world_base = pose_at(k) @ inverse(T_BASE_CAMERA)
        bag.add_pose_with_covariance(time_of(k), "/amcl_pose", T_world_base)
        if on_tf:
            bag.add_tf(time_of(k), ("map", "base_link", T_world_base))
    path = bag.write(tmp_path / "bag")
    assert not imported(path, tmp_path / "out")
    check_room(tmp_path / "out", posed=on_tf)
    assert (tmp_path / "out/poses.txt").exists() is on_tf
    assert ("imported without poses; set --poses /amcl_pose if" in caplog.text) is not on_tf


@pytest.mark.parametrize("child", ["", "odom", "/odom"])
def test_ros_bag_odometry_of_unnamed_frame_raises(tmp_path: Path, child: str) -> None:
    """VINS-Fusion names the fixed frame as the moving frame, and the bag connects it with the camera."""
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_odometry(time_of(k), "/vins/odometry", pose_at(k) @ inverse(T_BASE_CAMERA), child)
        bag.add_tf(time_of(k), ("odom", "body", pose_at(k) @ inverse(T_BASE_CAMERA)), ("body", OPTICAL, T_BASE_CAMERA))
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=r"from the moving frame, which has no name, to .*; set --camera-pose"):
        open_source(path)
    assert not imported(path, tmp_path / "out", poses="/tf")
    check_room(tmp_path / "out")


@pytest.mark.parametrize("offset", [-START, -3600, 3600, 1.0])
def test_ros_bag_poses_of_other_times_raise(tmp_path: Path, offset: float) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_odometry(time_of(k) + offset, "/odom", pose_at(k), OPTICAL)
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=r"/odom: expected poses at the times of the color images .*set --poses none"):
        open_source(path)


def test_ros_bag_tf_with_unknown_root_needs_choice(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_tf(time_of(k), ("pan_base", OPTICAL, pose_at(k)))
    path = bag.write(tmp_path / "bag")
    assert not open_source(path).posed
    assert "in the frame 'pan_base'; set --poses /tf if this frame is fixed" in caplog.text
    assert not imported(path, tmp_path / "out", poses="/tf")
    check_room(tmp_path / "out")


def test_ros_bag_tf_without_camera_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_tf(time_of(k), ("odom", "base_link", pose_at(k)))
    assert not open_source(bag.write(tmp_path / "bag")).posed
    assert "no frame of /tf moves the camera 'camera_color_optical_frame'; imported without poses" in caplog.text


def test_ros_bag_pose_stamped_of_robot_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_poses(bag)
    bag.add_static(("base_link", OPTICAL, T_BASE_CAMERA))
    path = bag.write(tmp_path / "bag")
    assert not imported(path, tmp_path / "out")
    check_room(tmp_path / "out")
    assert "/pose: poses are used as poses of the camera in optical axes; --camera-pose sets" in caplog.text
    bag.messages = [entry for entry in bag.messages if entry[1] != "/pose"]
    for k in range(COUNT):
        bag.add_pose(time_of(k), "/pose", pose_at(k) @ T_CAMERA_ROS)
    assert not imported_with(bag.write(tmp_path / "base"), tmp_path / "of_base", camera_pose=ROS_AXES)
    check_room(tmp_path / "of_base")


def test_ros_bag_damaged_transforms_are_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    bag.add_static((OPTICAL, DEPTH_FRAME, T_COLOR_DEPTH))
    bag.add_tf(time_of(1), ("odom", "base_link", np.eye(4)))
    path = bag.write(tmp_path / "bag")
    [file] = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        [[topic]] = database.execute("SELECT id FROM topics WHERE name = '/tf'")
        database.execute("UPDATE messages SET data = x'0001' WHERE topic_id = ?", [topic])
    assert not imported(path, tmp_path / "out")
    assert "/tf: expected a valid message" in caplog.text


def test_ros_bag_frame_with_two_parents_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_tf(time_of(k), ("odom", OPTICAL, pose_at(k)), ("map", OPTICAL, pose_at(k + 1)))
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match="expected one parent frame on /tf, got map and odom"):
        open_source(path)


def test_ros_bag_poses_none_imports_without_poses(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_odometry_of_base(bag)
    add_poses(bag)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out", poses="none")
    assert not (tmp_path / "out/poses.txt").exists()
    assert RgbdFolder(tmp_path / "out")[1].timestamp == pytest.approx(time_of(1), abs=1e-6)


def test_ros_bag_zero_poses_count_as_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_poses(bag)
    for _, _, kind, message in bag.messages:
        if kind.endswith("PoseStamped"):
            for part in (message.pose.position, message.pose.orientation):
                vars(part).update(dict.fromkeys(set(vars(part)) & set("xyzw"), 0.0))
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)
    assert not (tmp_path / "out/poses.txt").exists()
    assert "/pose: expected camera poses, got only zeros; imported without poses" in caplog.text
