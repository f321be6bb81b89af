"""Tests for ROS bags of a small room in all formats, including damaged bags."""

from __future__ import annotations

import json
import re
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rosbags")

from framework.datasets.frames.odometry import OdometryFile
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import ConfigError, DataError
from framework.files.tum_trajectory import read_tum
from framework.geometry import exp_se3, interpolate, inverse
from framework.importing.bags.ros_topics import BagOptions, Topics
from framework.importing.bags.transform_tree import stream_of
from framework.importing.formats import open_source
from tests.support.recordings.imported_bags import (
    DEPTH_CAMERA,
    KINDS,
    T_BASE_CAMERA,
    add_odometry_of_base,
    add_poses,
    add_separate_depth,
    check_room,
    imported,
    imported_with,
)
from tests.support.recordings.phone_exports import ROOM, T_COLOR_DEPTH, write_jpeg
from tests.support.recordings.ros_bags import (
    COUNT,
    START,
    BagWriter,
    add_camera_of_ros,
    add_realsense,
    compressed_depth,
    millimeters,
    png,
    seen,
    time_of,
)
from tests.support.recordings.rvl_files import rvl
from tests.support.scenes.corner_room import look, pose_at


@pytest.mark.parametrize("name", KINDS)
def test_ros_bag_of_camera_with_poses_is_imported(tmp_path: Path, name: str) -> None:
    bag = BagWriter(ros1=KINDS[name])
    add_camera_of_ros(bag)
    add_poses(bag)
    assert not imported(bag.write(tmp_path / name), tmp_path / "out")
    check_room(tmp_path / "out")


@pytest.mark.parametrize(("folder", "suffix"), [("mcap_folder", ".mcap"), ("plain", ".db3")])
def test_ros_bag_single_file_of_folder_is_imported(tmp_path: Path, folder: str, suffix: str) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    [file] = bag.write(tmp_path / folder).glob(f"*{suffix}")
    assert not imported(file, tmp_path / "out")
    assert not (tmp_path / "out/poses.txt").exists()
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_odometry_of_camera_frame_is_camera_pose(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    for k in range(COUNT):
        bag.add_odometry(time_of(k), "/odom", pose_at(k), "camera_color_optical_frame")
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out")


def test_ros_bag_odometry_of_base_is_written_for_camera(tmp_path: Path) -> None:
    """The transforms lead from the base over the mast to the camera. Odometry is not used as ground truth."""
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_odometry_of_base(bag)
    T_base_mast = exp_se3(np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3]))
    T_mast_camera = inverse(T_base_mast) @ T_BASE_CAMERA
    bag.add_static(("base_link", "mast", T_base_mast), ("mast", "camera_color_optical_frame", T_mast_camera))
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out", odometry="/odom")
    check_room(tmp_path / "out", posed=False)
    sequence = RgbdFolder(tmp_path / "out", odometry_file=OdometryFile(tmp_path / "out/odometry.txt"))
    for k, frame in enumerate(sequence):
        assert frame.T_world_camera is None
        assert frame.T_odom_camera is not None
        fraction = (frame.depth_time - time_of(k)) / (time_of(k + 1) - time_of(k))
        expected = interpolate(pose_at(k), pose_at(k + 1), fraction)
        np.testing.assert_allclose(frame.T_odom_camera, expected, atol=1e-5)


def test_ros_bag_odometry_without_transform_is_of_base(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_odometry_of_base(bag)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out", odometry="/odom")
    assert "expected the transform from base_link to camera_color_optical_frame in /tf_static, got none" in caplog.text
    _, poses = read_tum(tmp_path / "out/odometry.txt")
    np.testing.assert_allclose(poses[2], pose_at(2) @ inverse(T_BASE_CAMERA), atol=1e-6)


def test_ros_bag_poses_are_interpolated(tmp_path: Path) -> None:
    """The camera moves at 1 m/s along x, and the bag has two poses."""
    bag = BagWriter()
    add_camera_of_ros(bag)
    for x in (0.0, 0.13):
        T = np.eye(4)
        T[0, 3] = x
        bag.add_pose(time_of(0) - 0.01 + x, "/pose", T)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    walked = [frame.T_world_camera[0, 3] for frame in RgbdFolder(tmp_path / "out")]
    assert walked == pytest.approx([0.01 + k / 30 for k in range(COUNT)], abs=2e-6)


def test_ros_bag_frames_far_from_poses_are_skipped(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.add_pose(time_of(0) - 0.08, "/pose", np.eye(4))
    faults = imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert len(faults) == COUNT - 1
    assert "expected a pose, got none" in faults[0]


@pytest.mark.parametrize("encoding", ["bgr8", "rgba8", "bgra8", "mono8"])
def test_ros_bag_color_encodings_are_decoded(tmp_path: Path, encoding: str) -> None:
    bag = BagWriter()
    color, depth = seen(0)
    stored = {
        "bgr8": color[..., ::-1],
        "rgba8": np.dstack([color, color[..., :1]]),
        "bgra8": np.dstack([color[..., ::-1], color[..., :1]]),
        "mono8": color[..., 1],
    }[encoding]
    bag.add_image(time_of(0), "/rgb/image", stored, encoding, padding=3)
    bag.add_image(time_of(0), "/depth/image", millimeters(depth), "16UC1")
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    [frame] = RgbdFolder(tmp_path / "out")
    expected = color if encoding != "mono8" else np.repeat(color[..., 1:2], 3, axis=2)
    assert np.abs(frame.color.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    "kind", ["16UC1", "mono16", "Z16", "32FC1", "big-endian", "compressed", "packed mm", "packed m"]
)
def test_ros_bag_depth_encodings_are_decoded(tmp_path: Path, kind: str) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_image(time_of(k), "/rgb/image", color, "rgb8")
        bag.add_camera(time_of(k), "/rgb/camera_info", ROOM)
        stored, topic = millimeters(depth), "/depth/image"
        match kind:
            case "32FC1":
                bag.add_image(time_of(k), topic, np.where(depth > 0, depth, np.nan).astype("<f4"), kind)
            case "big-endian":
                bag.add_image(time_of(k), topic, stored.astype(">u2"), "16UC1")
            case "compressed":
                bag.add_compressed(time_of(k), f"{topic}/compressed", png(stored), "16UC1; png compressed")
            case "packed mm":
                bag.add_compressed(
                    time_of(k), f"{topic}/compressedDepth", bytes(12) + png(stored), "16UC1; compressedDepth png"
                )
            case "packed m":
                bag.add_compressed(time_of(k), f"{topic}/compressedDepth", *compressed_depth(depth))
            case _:
                bag.add_image(time_of(k), topic, stored, kind, padding=2)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_ros_bag_compressed_color_is_decoded(tmp_path: Path, kind: str) -> None:
    bag = BagWriter(ros1=True)
    for k in range(COUNT):
        color, depth = seen(k)
        write_jpeg(tmp_path / "image.jpg", color)
        data = (tmp_path / "image.jpg").read_bytes() if kind == "jpeg" else png(color[..., ::-1])
        bag.add_compressed(time_of(k), "/camera/rgb/image_raw/compressed", data, f"rgb8; {kind} compressed bgr8")
        bag.add_image(time_of(k), "/camera/depth/image_raw", millimeters(depth), "16UC1")
        bag.add_camera(time_of(k), "/camera/rgb/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "a.bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_realsense_depth_is_registered_to_color(tmp_path: Path) -> None:
    bag = BagWriter(ros1=True)
    add_realsense(bag, DEPTH_CAMERA)
    assert not imported(bag.write(tmp_path / "recorded.bag"), tmp_path / "out")
    # registration moves each depth value to the nearest pixel
    check_room(tmp_path / "out", posed=False, within=5e-3, holes=0.05)
    assert json.loads((tmp_path / "out/camera.json").read_text())["sensor"] == "REALSENSE_D435"


@pytest.mark.parametrize("ends", [("", ""), ("/compressed", "/compressedDepth")])
def test_ros_bag_realsense_compressed_images_are_imported(tmp_path: Path, ends: tuple[str, str]) -> None:
    bag = BagWriter()
    add_realsense(bag, DEPTH_CAMERA)
    for k, (time, topic, _, message) in enumerate(bag.messages):
        if topic.endswith("Color_0/image/data"):
            color = message.data.reshape(message.height, message.width, 3)
            packed = BagWriter()
            packed.add_compressed(time, topic + ends[0], png(color[..., ::-1]), "rgb8; png compressed bgr8")
            bag.messages[k] = packed.messages[0]
        elif topic.endswith("Depth_0/image/data"):
            depth = np.ascontiguousarray(message.data).view(np.uint16).reshape(message.height, message.width)
            packed = BagWriter()
            packed.add_compressed(time, topic + ends[1], bytes(12) + png(depth), "16UC1; compressedDepth png")
            bag.messages[k] = packed.messages[0]
    [file] = bag.write(tmp_path / "bag").glob("*.db3")
    assert not imported(file, tmp_path / "out")
    check_room(tmp_path / "out", posed=False, within=5e-3, holes=0.05)


def test_ros_bag_topics_of_unknown_driver_write_no_sensor(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag, "depth_registered")
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert "sensor" not in json.loads((tmp_path / "out/camera.json").read_text())


def test_ros_bag_unregistered_depth_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    path = bag.write(tmp_path / "bag")
    with pytest.raises(
        DataError,
        match=r"expected depth in the camera of /camera/color/image_raw.*; record /tf_static, .* --depth-registered",
    ):
        open_source(path)


def test_ros_bag_registered_depth_of_other_size_is_accepted(tmp_path: Path) -> None:
    bag = BagWriter()
    half = ROOM.scaled(0.5)
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/color/image_raw", seen(k)[0], "rgb8")
        bag.add_image(time_of(k), "/camera/depth/image_raw", millimeters(look(half, pose_at(k))[0]), "16UC1")
        bag.add_camera(time_of(k), "/camera/color/camera_info", ROOM)
        bag.add_camera(time_of(k), "/camera/depth/camera_info", half)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_lens_distortion_is_written_to_camera_json(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.messages = [entry for entry in bag.messages if not entry[1].endswith("camera_info")]
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM, lens=[0.1, -0.2, 0.001, 0.002, 0.05])
    imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert json.loads((tmp_path / "out/camera.json").read_text())["distortion"] == [0.1, -0.2, 0.001, 0.002, 0.05]
    assert RgbdFolder(tmp_path / "out").calibration.lens is not None


def test_ros_bag_unsupported_lens_model_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.messages = [entry for entry in bag.messages if not entry[1].endswith("camera_info")]
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM, "F-Theta", [0.1] * 5)
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=r"expected one of the lens models .*, got 'F-Theta' with 5 coefficients; use"):
        open_source(path)


def test_ros_bag_fisheye_lens_is_corrected_on_import(tmp_path: Path) -> None:
    """The lens of an identity mapping, r = tan(theta), has approximately these coefficients."""
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.messages = [entry for entry in bag.messages if not entry[1].endswith("camera_info")]
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM, "equidistant", [1 / 3, 2 / 15, 17 / 315, 62 / 2835])
    imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert "distortion" not in json.loads((tmp_path / "out/camera.json").read_text())
    check_room(tmp_path / "out", posed=False, holes=0.02)


def test_ros_bag_invalid_stamps_fall_back_to_recording_times(tmp_path: Path) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_image(time_of(k), "/camera/color/image_raw", color, "rgb8", stamp=0)
        bag.add_image(time_of(k) + 0.001, "/camera/depth_registered/image", millimeters(depth), "16UC1", stamp=0)
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_images_without_time_match_are_dropped(tmp_path: Path) -> None:
    bag = BagWriter()
    color, depth = seen(0)
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/color/image_raw", color, "rgb8")
    bag.add_image(time_of(2) + 0.003, "/camera/depth_registered/image", millimeters(depth), "16UC1")
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    path = bag.write(tmp_path / "bag")
    assert open_source(path).count == 1
    far = BagWriter(messages=[(t + 10 * ("depth" in topic), topic, *rest) for t, topic, *rest in bag.messages])
    for _, topic, _, message in far.messages:
        if "depth" in topic:
            message.header.stamp.sec += 10
    with pytest.raises(
        DataError, match=r"within 0\.02 s of each other, got none among 4 images on /camera/color/image_raw and 1 on"
    ):
        open_source(far.write(tmp_path / "far"))


# Times and units


def add_late_depth(bag: BagWriter, rate: float, late: float) -> None:
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_image(START + k / rate, "/camera/color/image_raw", color, "rgb8")
        bag.add_image(START + k / rate + late, "/camera/depth_registered/image", millimeters(depth), "16UC1")
    bag.add_camera(START, "/camera/color/camera_info", ROOM)


@pytest.mark.parametrize(("rate", "late"), [(10, 0.03), (10, -0.045), (15, 0.03), (5, 0.09), (2, 0.15)])
def test_ros_bag_pairs_within_half_a_frame(tmp_path: Path, rate: float, late: float) -> None:
    bag = BagWriter()
    add_late_depth(bag, rate, late)
    assert open_source(bag.write(tmp_path / "bag")).count == COUNT


def test_ros_bag_max_difference_option_is_applied(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_late_depth(bag, 30, 0.025)
    path = bag.write(tmp_path / "bag")
    open_source(path)  # the previous depth image is nearer
    assert "skipped 1 of 4 color images and 1 of 4 depth images without a partner within 0.02 s" in caplog.text
    assert open_source(path, None, BagOptions(max_difference=0.03)).count == COUNT - 1
    with pytest.raises(DataError, match=r"within 0.001 s .* got none .*; set --max-difference to a larger time"):
        open_source(path, None, BagOptions(max_difference=0.001))


@pytest.mark.parametrize("unit", [0.001, 0.01])
@pytest.mark.parametrize("missing", [0.0, np.nan, np.inf, -np.inf])
def test_ros_bag_float_depth_in_other_unit_needs_unit(tmp_path: Path, unit: float, missing: float) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        stored = np.where(np.arange(depth.shape[1]) % 9 == 0, missing, depth / unit).astype("<f4")
        bag.add_image(time_of(k), "/rgb/image", color, "rgb8")
        bag.add_image(time_of(k), "/depth/image", stored, "32FC1")
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    path = bag.write(tmp_path / "bag")
    with pytest.raises(
        DataError, match=rf"up to 65\.535 m, got a median of .*; set --depth-unit .*{unit:g} if it is in"
    ):
        imported(path, tmp_path / "failed")
    assert not imported_with(path, tmp_path / "out", depth_unit=unit)
    check_room(tmp_path / "out", posed=False, holes=0.2)


def test_ros_bag_without_depth_readings_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        bag.add_image(time_of(k), "/rgb/image", seen(k)[0], "rgb8")
        bag.add_image(time_of(k), "/depth/image", np.full(ROOM.shape, 65535, np.uint16), "16UC1")
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert "expected depth of at most 65.535 m, got no reading in 4 frames; check the unit of depth" in caplog.text


@pytest.mark.parametrize("transports", ["compressedDepth", "compressed compressedDepth"])
def test_ros_bag_image_transports_of_one_topic_are_merged(tmp_path: Path, transports: str) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_compressed(time_of(k), "/camera/color/image_raw/compressed", png(color[..., ::-1]), "rgb8; png")
        for name in transports.split():
            data = bytes(12 * (name == "compressedDepth")) + png(millimeters(depth))
            codec = "compressedDepth png" if name == "compressedDepth" else "png compressed"
            bag.add_compressed(time_of(k), f"/camera/aligned_depth/image_raw/{name}", data, f"16UC1; {codec}")
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


@pytest.mark.parametrize("ends", ["", "/compressed", "/compressedDepth", "/zstd"])
def test_stream_of_ignores_transport(ends: str) -> None:
    assert stream_of(f"/device_0/sensor_0/Depth_0/image/data{ends}") == "/device_0/sensor_0/Depth_0"


# Topics


def two_cameras() -> BagWriter:
    bag = BagWriter()
    color, depth = seen(0)
    for side in ("left", "right"):
        bag.add_image(time_of(0), f"/{side}/color/image", color, "rgb8")
        bag.add_image(time_of(0), f"/{side}/depth/image", millimeters(depth), "16UC1")
        bag.add_camera(time_of(0), f"/{side}/color/camera_info", ROOM)
        bag.add_pose(time_of(0), f"/{side}/pose", pose_at(0))
    return bag


@pytest.mark.parametrize(
    ("given", "output"),
    [
        ({}, r"expected one depth topic, got /left/depth/image, /right/depth/image; set --depth"),
        ({"depth": "/left/depth/image"}, r"expected one color topic, got .*; set --color"),
        (
            {"depth": "/left/depth/image", "color": "/left/color/image"},
            r"expected one topic with poses, got /left/pose, /right/pose; set --poses to one",
        ),
        (
            {"depth": "/left/depth/image", "color": "/left/color/image", "poses": "/left/color/image"},
            r"--poses: expected a topic of type nav_msgs/msg/Odometry or .*, got /left/color/image of type sensor_msgs",
        ),
        (
            {"depth": "/nowhere", "color": "/left/color/image", "poses": "/left/pose"},
            "--depth: expected a topic .*, got unknown topic /nowhere",
        ),
    ],
)
def test_ros_bag_ambiguous_or_invalid_topic_raises(tmp_path: Path, given: dict[str, str], output: str) -> None:
    path = two_cameras().write(tmp_path / "bag")
    with pytest.raises(ConfigError, match=output):
        open_source(path, Topics(**given))


def test_ros_bag_given_topics_are_used(tmp_path: Path) -> None:
    path = two_cameras().write(tmp_path / "bag")
    given = {"depth": "/right/depth/image", "color": "/left/color/image", "poses": "/left/pose"}
    assert not imported(path, tmp_path / "out", **given, camera_info="/right/color/camera_info")
    assert len(RgbdFolder(tmp_path / "out")) == 1


def test_ros_bag_prefers_registered_depth_and_raw_color(tmp_path: Path) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    color, depth = seen(0)
    bag.add_image(time_of(0), "/camera/depth/image_rect_raw", millimeters(2 * depth), "16UC1")
    bag.add_image(time_of(0), "/camera/infra1/image_rect_raw", color[..., 0], "mono8")
    bag.add_compressed(time_of(0), "/camera/color/image_raw/compressed", b"no picture", "jpeg")
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


@pytest.mark.parametrize(
    ("left_out", "output"),
    [
        ("/color/image", "expected one color topic, got none"),
        ("camera_info", "expected a sensor_msgs/msg/CameraInfo topic next to .*, got none"),
    ],
)
def test_ros_bag_missing_topic_raises(tmp_path: Path, left_out: str, output: str) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    bag.messages = [entry for entry in bag.messages if left_out not in entry[1]]
    path = bag.write(tmp_path / "bag")
    with pytest.raises((ConfigError, DataError), match=output):
        open_source(path)


def test_topic_options_for_phone_export_raise(tmp_path: Path) -> None:
    (tmp_path / "a.r3d").touch()
    with pytest.raises(ConfigError, match="--color, --poses: expected a ROS bag, got"):
        open_source(tmp_path / "a.r3d", Topics(color="/a", poses="/b"))


# Gravity

UP_WORLD = np.array([0.0, -1.0, 0.0])  # the y axis of the room points down
R_IMU_CAMERA = Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix()


def add_accelerometer(
    bag: BagWriter, topic: str = "/camera/imu", frame_id: str = "imu", length: float = 9.81, late: float = 0.0
) -> None:
    """Add accelerometer messages of a slowly rotating camera at 300 Hz, with vibrations of 4 m/s^2 at 50 Hz.

    Args:
        bag: Bag that receives the messages.
        topic: Topic of the messages.
        frame_id: Frame of the sensor.
        length: Magnitude of gravity, m/s^2.
        late: Offset of the timestamps, s.
    """
    for n in range(-30, 10 * COUNT + 30):
        acceleration = length * UP_WORLD + np.array([4.0, 0, 0]) * np.sin(2 * np.pi * n / 6)
        measured = R_IMU_CAMERA @ pose_at(n / 10)[:3, :3].T @ acceleration
        bag.add_imu(START + n / 300 + late, topic, measured, frame_id)


def stands(R: np.ndarray) -> np.ndarray:
    T = exp_se3(np.array([0.1, 0.2, -0.1, 0, 0, 0]))
    T[:3, :3] = R
    return T


def check_up(folder: Path, within: float = 1.0) -> None:
    for k, frame in enumerate(RgbdFolder(folder)):
        assert np.degrees(np.arccos(frame.up @ pose_at(k)[:3, :3].T @ UP_WORLD)) < within


@pytest.mark.parametrize("name", ["ros1.bag", "ros2_folder"])
def test_ros_bag_accelerometer_gives_up_vector_in_camera_axes(tmp_path: Path, name: str) -> None:
    """Some transforms must be inverted. Gyroscope messages have no acceleration."""
    bag = BagWriter(ros1=KINDS[name])
    add_camera_of_ros(bag)
    add_accelerometer(bag)
    bag.add_imu(time_of(0), "/camera/gyro/sample", np.zeros(3), "imu")
    base = Rotation.random(random_state=1).as_matrix()
    bag.add_static(
        ("base", "/camera_color_optical_frame", stands(base)),
        ("base", "imu_mount", stands(base @ R_IMU_CAMERA.T)),
        ("imu_mount", "imu", stands(np.eye(3))),
        ("elsewhere", "base", stands(np.eye(3))),
    )
    assert not imported(bag.write(tmp_path / name), tmp_path / "out")
    check_up(tmp_path / "out")


def test_ros_bag_realsense_accelerometer_gives_up_vector(tmp_path: Path) -> None:
    bag = BagWriter(ros1=True)
    add_realsense(bag, DEPTH_CAMERA)
    add_accelerometer(bag, "/device_0/sensor_2/Accel_0/imu/data", "2")
    T_color_reference = T_COLOR_DEPTH
    bag.add_transform("/device_0/sensor_2/Accel_0/tf/0", stands(R_IMU_CAMERA @ T_color_reference[:3, :3]))
    assert not imported(bag.write(tmp_path / "recorded.bag"), tmp_path / "out")
    check_up(tmp_path / "out")


@pytest.mark.parametrize(
    ("changed", "output"),
    [
        (
            {"frame_id": "unheard_of"},
            "/camera/imu: expected the rotation from this sensor to the camera of /camera/color/image_raw in the bag",
        ),
        ({"length": 0.0}, r"/camera/imu: expected a median acceleration of 9\.81 m/s\^2, got 3\.46 m/s\^2"),
        ({"late": 100.0}, r"/camera/imu: expected a measurement within 0\.05 s of a frame"),
    ],
)
def test_ros_bag_unusable_accelerometer_logs_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, changed: dict[str, Any], output: str
) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_accelerometer(bag, **changed)
    bag.add_static(("imu", "camera_color_optical_frame", stands(R_IMU_CAMERA)))
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert not (tmp_path / "out/gravity.txt").exists()
    [line] = [record.getMessage() for record in caplog.records if "accelerometer" in record.getMessage()]
    assert re.search(f"no accelerometer is usable: {output}", line)
    assert "\n" not in line


def test_ros_bag_damaged_accelerometer_messages_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    add_accelerometer(bag)
    bag.add_static(("imu", "camera_color_optical_frame", stands(R_IMU_CAMERA)))
    for number, (time, topic, kind, message) in enumerate(bag.messages):
        if topic == "/camera/imu" and number % 3 == 0:
            lost = replace(message, linear_acceleration=bag.vector(np.full(3, np.nan)))
            bag.messages[number] = (time, topic, kind, lost)
    path = bag.write(tmp_path / "plain")
    [file] = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        [[topic]] = database.execute("SELECT id FROM topics WHERE name = '/camera/imu'")
        database.execute("UPDATE messages SET data = x'0001' WHERE topic_id = ? AND id % 5 = 0", [topic])
    assert not imported(path, tmp_path / "out")
    assert re.search(r"skipped [1-9]\d* damaged messages of /camera/imu", caplog.text)
    check_up(tmp_path / "out", within=10)


# Damage


def spoilt(message: Any, name: str) -> Any:
    fields = {
        "encoding": {"encoding": "nv21"},
        "height": {"height": 10_000},
        "step": {"step": 5},
        "width": {"width": 2**31},
        "data": {"data": message.data[:-7]},
        "stamp": {},
    }[name]
    return replace(message, **fields)


@pytest.mark.parametrize("topic", ["/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"])
@pytest.mark.parametrize("name", ["encoding", "height", "step", "width", "data"])
def test_ros_bag_damaged_message_skips_one_frame(tmp_path: Path, topic: str, name: str) -> None:
    bag = BagWriter()
    add_camera_of_ros(bag)
    number = [k for k, entry in enumerate(bag.messages) if entry[1] == topic][1]
    time, _, kind, message = bag.messages[number]
    bag.messages[number] = (time, topic, kind, spoilt(message, name))
    [fault] = imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert topic in fault
    assert re.search("expected [0-9]+ bytes for .* px of|expected one of the (color|depth) encodings", fault)
    assert len(RgbdFolder(tmp_path / "out")) == COUNT - 1


@pytest.mark.parametrize("depth", [b"", b"123", bytes(12), bytes(12) + b"\x89PNG\r\n\x1a\n" + bytes(40)])
def test_ros_bag_damaged_compressed_depth_skips_one_frame(tmp_path: Path, depth: bytes) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, metric = seen(k)
        bag.add_image(time_of(k), "/rgb/image", color, "rgb8")
        data = depth if k == 1 else bytes(12) + png(millimeters(metric))
        bag.add_compressed(time_of(k), "/depth/image/compressedDepth", data, "16UC1; compressedDepth png")
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    [fault] = imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert "/depth/image/compressedDepth" in fault


@pytest.mark.parametrize(
    ("codec", "header", "named"),
    [
        ("rvl", bytes(12), "16UC1; compressedDepth rvl"),
        ("inverse rvl", b"", "32FC1; compressedDepth rvl"),
        ("png", bytes(12), "16UC1; compressedDepth"),
        ("png", bytes(12), "png"),
        ("png", b"", "16UC1; compressedDepth png"),
        ("png", b"", "16UC1; png compressed "),
    ],
)
def test_ros_bag_compressed_depth_is_decoded(tmp_path: Path, codec: str, header: bytes, named: str) -> None:
    bag = BagWriter(ros1=codec == "png")
    for k in range(COUNT):
        color, metric = seen(k)
        bag.add_image(time_of(k), "/rgb/image", color, "rgb8")
        data = header + (png if codec == "png" else rvl)(millimeters(metric))
        if codec == "inverse rvl":
            data = compressed_depth(metric, rvl)[0]
        bag.add_compressed(time_of(k), "/depth/image/compressedDepth", data, named)
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / ("a.bag" if bag.ros1 else "bag")), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_damaged_rvl_depth_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    bag.add_image(time_of(0), "/rgb/image", seen(0)[0], "rgb8")
    bag.add_compressed(time_of(0), "/depth/image/compressedDepth", bytes(100), "16UC1; compressedDepth rvl")
    bag.add_camera(time_of(0), "/rgb/camera_info", ROOM)
    with pytest.raises(DataError, match=r"expected usable frames, got none; .* an RVL image of .*, got 0x0 px"):
        imported(bag.write(tmp_path / "bag"), tmp_path / "out")


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
def test_ros_bag_truncated_is_imported_or_raises_one_line_error(tmp_path: Path, name: str, share: float) -> None:
    bag = BagWriter(ros1=KINDS[name])
    add_camera_of_ros(bag)
    path = bag.write(tmp_path / name)
    file = path if path.is_file() else next(entry for entry in path.iterdir() if entry.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    try:
        imported(path, tmp_path / "out")
    except DataError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)
        assert not (tmp_path / "out/camera.json").exists()
    else:
        assert 0 < len(RgbdFolder(tmp_path / "out")) <= COUNT


def test_ros_bag_inverted_byte_skips_at_most_one_frame(tmp_path: Path) -> None:
    bag = BagWriter(ros1=True)
    add_camera_of_ros(bag)
    path = bag.write(tmp_path / "a.bag")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    assert len(imported(path, tmp_path / "out")) <= 1
    assert len(RgbdFolder(tmp_path / "out")) >= COUNT - 1


def test_ros_bag_missing_package_error_names_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").touch()
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(ConfigError, match=r"rosbags: expected an installed package \(it reads ROS bags\), got none"):
        open_source(tmp_path / "a.bag")


def test_ros_bag_import_writes_times_of_both_images(tmp_path: Path) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_image(time_of(k), "/camera/color/image_raw", color, "rgb8")
        bag.add_image(time_of(k) + 0.004, "/camera/depth_registered/image", millimeters(depth), "16UC1")
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    frame = RgbdFolder(tmp_path / "out")[1]
    assert frame.color_time == pytest.approx(time_of(1), abs=1e-6)
    assert frame.depth_time - frame.color_time == pytest.approx(0.004, abs=1e-6)
