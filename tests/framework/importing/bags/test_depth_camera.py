"""Tests for the cameras in ROS bags, and for the registration of depth to color."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from framework.data import Camera
from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.geometry import exp_se3, inverse
from framework.importing.formats import open_source
from tests.support.recordings.imported_bags import (
    DEPTH_FRAME,
    KINDS,
    OPTICAL,
    add_separate_depth,
    check_room,
    imported,
    imported_with,
)
from tests.support.recordings.phone_exports import ROOM, T_COLOR_DEPTH
from tests.support.recordings.ros_bags import (
    COUNT,
    T_CAMERA_ROS,
    BagWriter,
    millimeters,
    png,
    seen,
    time_of,
)
from tests.support.scenes.corner_room import look, pose_at

T_LINK_DEPTH = exp_se3(np.array([0.0, 0.01, 0.02, 0.1, -0.2, 0.3])) @ T_CAMERA_ROS.T
T_LINK_COLOR = T_LINK_DEPTH @ inverse(T_COLOR_DEPTH)


def split(name: str, T_link_depth: np.ndarray, T_link_color: np.ndarray, bag: BagWriter) -> None:
    """Add the transforms between the cameras in one of several layouts."""
    if name == "direct":
        bag.add_static((OPTICAL, DEPTH_FRAME, T_COLOR_DEPTH))
    elif name == "inverse":
        bag.add_static((DEPTH_FRAME, OPTICAL, inverse(T_COLOR_DEPTH)))
    elif name == "link":
        bag.add_static(("camera_link", DEPTH_FRAME, T_link_depth), ("camera_link", OPTICAL, T_link_color))
    elif name == "messages":
        bag.add_static(("camera_link", DEPTH_FRAME, T_link_depth))
        bag.add_static(("/camera_link", f"/{OPTICAL}", T_link_color))
    elif name == "tf":  # static_transform_publisher of early ROS 1 repeats the transforms on /tf
        for n in range(4):
            for child, T in ((DEPTH_FRAME, T_link_depth), (OPTICAL, T_link_color)):
                bag.add_tf(time_of(0) + n, ("camera_link", child, T))


@pytest.mark.parametrize("name", ["ros1.bag", "ros2_folder"])
@pytest.mark.parametrize("layout", ["direct", "inverse", "link", "messages", "tf"])
def test_ros_bag_depth_is_registered_by_transform_tree(tmp_path: Path, name: str, layout: str) -> None:
    bag = BagWriter(ros1=KINDS[name])
    add_separate_depth(bag)
    split(layout, T_LINK_DEPTH, T_LINK_COLOR, bag)
    assert not imported(bag.write(tmp_path / name), tmp_path / "out")
    check_room(tmp_path / "out", posed=False, within=5e-3, holes=0.05)


def test_ros_bag_contradicting_transforms_raise(tmp_path: Path) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    bag.add_static((OPTICAL, DEPTH_FRAME, T_COLOR_DEPTH))
    bag.add_static((OPTICAL, DEPTH_FRAME, np.eye(4)))
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match="expected one transform on /tf_static, got several that contradict"):
        open_source(path)


def test_ros_bag_contradicting_paths_raise(tmp_path: Path) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    bag.add_static(
        (OPTICAL, DEPTH_FRAME, T_COLOR_DEPTH), (OPTICAL, "link", np.eye(4)), ("link", DEPTH_FRAME, np.eye(4))
    )
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=r"expected one transform .*, got two paths that contradict each other"):
        open_source(path)


def test_ros_bag_moving_joint_between_cameras_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    for k in range(COUNT):
        bag.add_tf(time_of(k), (OPTICAL, DEPTH_FRAME, exp_se3(np.array([0, 0, 0, 0.1 * k, 0, 0]))))
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=r"expected a rigid transform .*, got a moving joint"):
        open_source(path)


@pytest.mark.parametrize(
    ("topic", "size", "output"),
    [
        ("/camera/depth/image_rect_raw", (424, 240), "expected the aspect ratio of color"),
        ("/camera/depth/image_raw", (424, 240), "expected the aspect ratio of color"),
        ("/camera/depth/image_rect_raw", (160, 120), "no CameraInfo; set --depth-registered"),
        ("/camera/aligned_depth_to_color/image_raw", (424, 240), "expected the aspect ratio of color"),
        ("/depth/image", (320, 320), "expected the aspect ratio of color"),
    ],
)
def test_ros_bag_depth_without_camera_info_raises(
    tmp_path: Path, topic: str, size: tuple[int, int], output: str
) -> None:
    bag = BagWriter()
    add_separate_depth(bag, topic, info=False, camera=Camera(*size, 210.0, 210.0, size[0] / 2, size[1] / 2))
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match=output):
        open_source(path)


def test_ros_bag_depth_registered_option_is_applied(tmp_path: Path) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        color, depth = seen(k)
        bag.add_image(time_of(k), "/camera/color/image_raw", color, "rgb8")
        bag.add_image(time_of(k), "/camera/depth/image_raw", millimeters(depth), "16UC1", frame_id=DEPTH_FRAME)
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    path = bag.write(tmp_path / "bag")
    assert not imported_with(path, tmp_path / "out", depth_registered=True)
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_camera_info_of_depth_alone_raises(tmp_path: Path) -> None:
    bag = BagWriter()
    add_separate_depth(bag)
    bag.messages = [entry for entry in bag.messages if entry[1] != "/camera/color/camera_info"]
    for _, _, kind, message in bag.messages:
        if kind.endswith("CameraInfo"):
            message.header.frame_id = DEPTH_FRAME
    path = bag.write(tmp_path / "bag")
    with pytest.raises(DataError, match="got only /camera/depth/camera_info, which belongs to /camera/depth/image"):
        open_source(path)


RAW_LENS = Camera(ROOM.width, ROOM.height, 1.2 * ROOM.fx, 1.2 * ROOM.fy, ROOM.cx + 5, ROOM.cy - 5)


@pytest.mark.parametrize(
    "topic",
    [
        "/rgb/image_rect_color",
        "/rgb/image_rect",
        "/kinect2/qhd/image_color_rect",
        "/zed/left/image_rect_color",
        "/rgb/image_rect_color/compressed",
    ],
)
@pytest.mark.parametrize("ros1", [True, False])
def test_ros_bag_rectified_color_uses_projection_matrix(tmp_path: Path, topic: str, ros1: bool) -> None:
    bag = BagWriter(ros1)
    for k in range(COUNT):
        color, depth = seen(k)
        if topic.endswith("compressed"):
            bag.add_compressed(time_of(k), topic, png(color[..., ::-1]), "rgb8; png compressed bgr8")
        else:
            bag.add_image(time_of(k), topic, color, "rgb8")
        bag.add_image(time_of(k), "/depth_registered/image_rect", millimeters(depth), "16UC1")
    name = f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
    bag.add_camera(time_of(0), name, RAW_LENS, lens=[0.05, -0.1, 0.001, 0.001, 0], rectified=ROOM)
    assert not imported(bag.write(tmp_path / ("a.bag" if ros1 else "bag")), tmp_path / "out")
    assert "distortion" not in json.loads((tmp_path / "out/camera.json").read_text())
    check_room(tmp_path / "out", posed=False)


def test_ros_bag_raw_depth_is_moved_to_rectified_color(tmp_path: Path) -> None:
    """Hardware-registered depth of OpenNI is in the raw camera, and the recorded color is rectified."""
    bag = BagWriter()
    for k in range(COUNT):
        raw_depth = look(RAW_LENS, pose_at(k))[0]
        bag.add_image(time_of(k), "/camera/rgb/image_rect_color", seen(k)[0], "rgb8")
        bag.add_image(time_of(k), "/camera/depth_registered/image_raw", millimeters(raw_depth), "16UC1")
    bag.add_camera(time_of(0), "/camera/rgb/camera_info", RAW_LENS, rectified=ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False, within=5e-3, holes=0.4)


# Cameras whose images differ from the CameraInfo

R_RECTIFIED = exp_se3(np.array([0, 0, 0, 0.05, 0.02, -0.03]))
LARGE = replace(ROOM, width=ROOM.width + 40, height=ROOM.height + 60, cx=ROOM.cx + 20, cy=ROOM.cy + 30)
CROPPED = replace(ROOM, height=ROOM.height - 40, cy=ROOM.cy - 20)
ALIGNED, REGISTERED_INFO = "/camera/aligned_depth_to_color/image_raw", "/camera/depth_registered/camera_info"
# color topic, depth topic, depth camera, T_color_depth, CameraInfo topics with the parameters of add_camera
INFOS: dict[str, tuple[str, str, Camera, np.ndarray, dict[str, dict[str, Any]]]] = {
    "binned": (
        "/camera/color/image_raw",
        ALIGNED,
        ROOM,
        np.eye(4),
        {"/camera/color/camera_info": {"camera": ROOM.scaled(2), "binning": 2}},
    ),
    "binned and rectified": (
        "/camera/rgb/image_rect_color",
        "/camera/depth_registered/image_rect",
        ROOM,
        np.eye(4),
        {"/camera/rgb/camera_info": {"camera": RAW_LENS.scaled(4), "rectified": ROOM.scaled(4), "binning": 4}},
    ),
    "region": (
        "/camera/color/image_raw",
        ALIGNED,
        ROOM,
        np.eye(4),
        {"/camera/color/camera_info": {"camera": LARGE, "region": (20, 30, ROOM.height, ROOM.width)}},
    ),
    "region of a binned image": (
        "/camera/color/image_raw",
        ALIGNED,
        ROOM,
        np.eye(4),
        {
            "/camera/color/camera_info": {
                "camera": LARGE.scaled(2),
                "binning": 2,
                "region": (40, 60, 2 * ROOM.height, 2 * ROOM.width),
            }
        },
    ),
    "whole image as region": (
        "/camera/color/image_raw",
        ALIGNED,
        ROOM,
        np.eye(4),
        {"/camera/color/camera_info": {"camera": ROOM, "binning": 1, "region": (0, 0, ROOM.height, ROOM.width)}},
    ),
    "registered and cropped": (
        "/camera/rgb/image_color",
        "/camera/depth_registered/image",
        CROPPED,
        np.eye(4),
        {"/camera/rgb/camera_info": {"camera": ROOM}, REGISTERED_INFO: {"camera": CROPPED}},
    ),
    "oak-d": (
        "/oak/rgb/image_raw",
        "/oak/stereo/image_raw",
        CROPPED,
        np.eye(4),
        {"/oak/rgb/camera_info": {"camera": ROOM}, "/oak/stereo/camera_info": {"camera": CROPPED}},
    ),
    "raw color of rectified depth": (
        "/stereo/left/image_raw",
        "/stereo/depth/image_rect",
        ROOM,
        inverse(R_RECTIFIED),
        {"/stereo/left/camera_info": {"camera": ROOM, "R": R_RECTIFIED[:3, :3]}},
    ),
    "rectified color of raw depth": (
        "/camera/rgb/image_rect_color",
        "/camera/depth_registered/image_raw",
        ROOM,
        R_RECTIFIED,
        {"/camera/rgb/camera_info": {"camera": ROOM, "R": R_RECTIFIED[:3, :3]}},
    ),
    "rectified color and depth": (
        "/stereo/left/image_rect_color",
        "/stereo/depth",
        ROOM,
        np.eye(4),
        {"/stereo/left/camera_info": {"camera": RAW_LENS, "rectified": ROOM, "R": R_RECTIFIED[:3, :3]}},
    ),
}


@pytest.mark.parametrize("name", INFOS)
def test_ros_bag_camera_info_of_other_images_is_converted(tmp_path: Path, name: str) -> None:
    color_topic, depth_topic, depth_camera, T_color_depth, infos = INFOS[name]
    bag = BagWriter(ros1="rectified" in name)
    for k in range(COUNT):
        depth = look(depth_camera, pose_at(k) @ T_color_depth)[0]
        bag.add_image(time_of(k), color_topic, seen(k)[0], "rgb8")
        bag.add_image(time_of(k), depth_topic, millimeters(depth), "16UC1")
    for topic, parameters in infos.items():
        bag.add_camera(time_of(0), topic, **parameters)
    assert not imported(bag.write(tmp_path / ("a.bag" if bag.ros1 else "bag")), tmp_path / "out")
    check_room(tmp_path / "out", posed=False, within=5e-3, holes=0.3)


LENS = [0.1, -0.2, 0.001, 0.001, 0.0]


def test_ros_bag_rectified_depth_has_no_lens_of_raw_color(tmp_path: Path) -> None:
    """The color images have a lens, and depth belongs to the pinhole camera of the same CameraInfo."""
    bag = BagWriter()
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/rgb/image_color", seen(k)[0], "rgb8")
        bag.add_image(time_of(k), "/camera/depth_registered/image_rect", millimeters(seen(k)[1]), "16UC1")
    bag.add_camera(time_of(0), "/camera/rgb/camera_info", ROOM, lens=LENS)
    imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    assert "distortion" not in json.loads((tmp_path / "out/camera.json").read_text())
    for k, frame in enumerate(RgbdFolder(tmp_path / "out")):
        has_reading = frame.depth > 0
        assert np.median(np.abs(frame.depth - seen(k)[1])[has_reading]) < 5e-3


# Selection by encoding


def add_gray(bag: BagWriter, *topics: str) -> None:
    for topic in topics:
        bag.add_image(time_of(0), topic, seen(0)[0][..., 0], "mono8")


@pytest.mark.parametrize(
    ("color", "depth", "others"),
    [
        ("/oak/rgb/image_raw", "/oak/stereo/image_raw", ()),
        ("/oak/rgb/image_raw", "/oak/stereo/image_raw", ("/oak/left/image_raw", "/oak/right/image_raw")),
        ("/camera/color/image_raw", "/camera/range/image", ()),
        ("/camera/image", "/camera/tof/image", ()),
        ("/rgb_to_depth/image_raw", "/depth/image_raw", ()),
        ("/camera/color/image_raw", "/camera/depth/image_raw", ("/camera/depth/image_color",)),
    ],
)
def test_ros_bag_depth_topic_is_selected_by_encoding(
    tmp_path: Path, color: str, depth: str, others: tuple[str, ...]
) -> None:
    bag = BagWriter()
    add_gray(bag, *others)
    for k in range(COUNT):
        bag.add_image(time_of(k), color, seen(k)[0], "rgb8")
        bag.add_image(time_of(k), depth, seen(k)[1].astype("<f4"), "32FC1")
    bag.add_camera(time_of(0), f"{color.rpartition('/')[0]}/camera_info", ROOM)
    assert not imported(bag.write(tmp_path / "bag"), tmp_path / "out")
    check_room(tmp_path / "out", posed=False)


@pytest.mark.parametrize(
    ("topic", "frame", "is_accepted"),
    [
        ("/camera/color/camera_info", "camera_link", True),  # the namespace of the images
        ("/camera_info", OPTICAL, True),
        ("/sensors/front/camera_info", f"/{OPTICAL}", True),
        ("/sensors/front/camera_info", "", True),
        ("/wrist/camera_info", "wrist_optical", False),
        ("/camera/infra1/camera_info", "camera_infra1_optical_frame", False),
        ("/camera/depth/camera_info", DEPTH_FRAME, False),
    ],
)
def test_ros_bag_camera_info_of_other_camera_raises(tmp_path: Path, topic: str, frame: str, is_accepted: bool) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/color/image_raw", seen(k)[0], "rgb8")
        bag.add_image(time_of(k), ALIGNED, millimeters(seen(k)[1]), "16UC1")
    bag.add_camera(time_of(0), topic, ROOM, frame_id=frame)
    path = bag.write(tmp_path / "bag")
    if is_accepted:
        assert not imported(path, tmp_path / "out")
        check_room(tmp_path / "out", posed=False)
        return
    with pytest.raises(DataError, match=f"got only {topic}, which belongs to {frame}; set --camera-info {topic} if"):
        open_source(path)
    assert not imported(path, tmp_path / "out", camera_info=topic)


SIMILAR = replace(ROOM, fx=1.01 * ROOM.fx, fy=1.01 * ROOM.fy, cx=ROOM.cx + 1)  # such as depth and color of a D455


@pytest.mark.parametrize(
    ("camera", "frame", "is_accepted"),
    [
        (ROOM, DEPTH_FRAME, True),  # the driver copies the CameraInfo of color
        (ROOM.scaled(0.5), DEPTH_FRAME, True),
        (ROOM.scaled(2), "", True),
        (SIMILAR, DEPTH_FRAME, False),
        (SIMILAR.scaled(0.5), DEPTH_FRAME, False),
        (SIMILAR, "", False),
    ],
)
def test_ros_bag_depth_of_similar_camera_is_not_registered(
    tmp_path: Path, camera: Camera, frame: str, is_accepted: bool
) -> None:
    bag = BagWriter()
    for k in range(COUNT):
        bag.add_image(time_of(k), "/camera/color/image_raw", seen(k)[0], "rgb8")
        depth = millimeters(look(camera, pose_at(k))[0])
        bag.add_image(time_of(k), "/camera/depth/image_rect_raw", depth, "16UC1", frame_id=frame)
    bag.add_camera(time_of(0), "/camera/color/camera_info", ROOM)
    bag.add_camera(time_of(0), "/camera/depth/camera_info", camera, frame_id=frame)
    path = bag.write(tmp_path / "bag")
    if not is_accepted:
        with pytest.raises(DataError, match=r"expected depth in the camera of .* or extrinsics in the bag"):
            open_source(path)
        return
    assert not imported(path, tmp_path / "out")
    check_room(tmp_path / "out", posed=False, within=5e-3)
