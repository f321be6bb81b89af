"""The depth camera in a ROS bag: its unit, and its registration to the color camera.

Depth counts as registered if its topic is named so, if it has the frame of color, or on request. All other depth images
are registered with their CameraInfo and the transform tree of the bag. Without transforms, depth with the intrinsics of
color counts as registered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Camera, Float32, Float64
from framework.errors import DataError, FrameError
from framework.geometry import inverse
from framework.importing.bags.ros_camera import RosLens, is_rectified, rectification, ros_camera
from framework.importing.bags.ros_images import MILLIMETER, decode_ros_depth
from framework.importing.bags.ros_messages import Message, RosBag
from framework.importing.bags.ros_topics import BagOptions, Topics, camera_info_of, is_of_camera
from framework.importing.bags.transform_tree import REALSENSE, TransformTree
from framework.importing.depth_resampling import DepthRegistration

# fraction of the image width, maximum difference between the intrinsics of cameras with the same pose, and between
# those of depth and color if the bag does not show the poses
SIMILAR, COPIED = 0.01, 0.001
SAME_PROPORTIONS = 0.01  # maximum relative difference between the aspect ratios of registered images
FARTHEST = 65.535  # m, maximum depth of the written images
DEPTH_STREAM = "/Depth_"  # in RealSense's topic names
FIX = "record registered depth, such as aligned_depth_to_color"


@dataclass(frozen=True)
class BagDepth:
    """The depth camera of a bag."""

    bag: RosBag
    unit: float  # m, of integer depth
    float_unit: float  # m, of float depth
    lens: RosLens | None  # of depth; None = pinhole camera
    registration: DepthRegistration | None  # None = depth is registered to color, possibly at another resolution

    def depth(self, where: str, message: Message) -> Float32:
        """Return the depth image (h, w), m, registered to color, 0 = no reading.

        Args:
            where: The location of the message, for error messages.
            message: The message.

        Raises:
            FrameError: The image is invalid.
        """
        depth = decode_ros_depth(f"{where}: {message.topic}", self.bag.decoded(message), self.unit, self.float_unit)
        middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 0.0
        if middle > FARTHEST:
            raise FrameError(
                f"{where}: {message.topic}: expected depth up to {FARTHEST:g} m, got a median of {middle:.6g} m; set "
                "--depth-unit 0.001 if it is in millimeters, or 0.01 if it is in centimeters"
            )
        if self.lens is not None:
            depth = self.lens.exact(depth)
        if self.registration is None:
            return depth
        if depth.shape != self.registration.depth.shape:
            sizes = [f"{width}x{height}" for height, width in (self.registration.depth.shape, depth.shape)]
            expected = f"expected depth of {sizes[0]} px as in its CameraInfo"
            raise FrameError(f"{where}: {expected}, got {sizes[1]} px")
        return self.registration.apply(depth)


def find_depth_camera(
    bag: RosBag, topics: Topics, tree: TransformTree, options: BagOptions, color: Camera, color_lens: RosLens | None
) -> BagDepth:
    """Return the depth camera of a bag.

    Args:
        bag: The bag.
        topics: The selected topics.
        tree: The coordinate frames of the bag.
        options: The options of the user.
        color: The color camera.
        color_lens: The lens of the color camera; None = pinhole camera.

    Raises:
        DataError: The bag does not show where the depth camera is.
    """
    color_info = bag.first(topics.camera_info)
    integer, single = (options.depth_unit,) * 2 if options.depth_unit else (_integer_unit(bag, topics), 1.0)
    topic = topics.depth
    own = camera_info_of(bag, topic)
    if own in ("", topics.camera_info) or not is_of_camera(bag, tree, own, topic):
        own = ""
    info = bag.first(own) if own else None
    frames = [tree.frame_of(name) for name in (topics.color, topic)]
    has_same_frame = frames[0] == frames[1] != ""
    has_equal_rectification = _has_equal_rectification(topics)
    plain = BagDepth(bag, integer, single, color_lens, None)
    if info is None and not (topics.depth_is_registered or options.depth_registered or has_same_frame):
        _check_proportions(bag, topic, color)
        raise DataError(
            f"{bag.path}: {topic}: expected registered depth, or depth with a CameraInfo, got the frame "
            f"{frames[1]!r}, color in {frames[0]!r} and no CameraInfo; set --depth-registered if depth is registered "
            f"to color, or {FIX}"
        )
    if info is None:
        _check_proportions(bag, topic, color)
        if has_equal_rectification:
            return plain
    rectified = is_rectified(topics.color if has_equal_rectification else topic)
    depth, lens = ros_camera(f"{bag.path}: {own or topics.camera_info}", info or color_info, rectified)
    is_registered = info is None or topics.depth_is_registered or has_same_frame
    T_color_depth = _rotation(topics, color_info) if is_registered else tree.fixed(to=frames[0], of=frames[1])
    if T_color_depth is None and options.depth_registered:
        T_color_depth = np.eye(4)
    if T_color_depth is None and _is_same(depth, color, COPIED):  # other cameras may be similar
        return plain
    if T_color_depth is None:
        raise DataError(
            f"{bag.path}: {topic}: expected depth in the camera of {topics.color}, or extrinsics in the bag, got "
            f"the camera of {own} without extrinsics; record /tf_static, or {FIX}; set --depth-registered if both "
            "cameras have the same pose"
        )
    has_equal_lens = (lens and lens.coefficients) == (color_lens and color_lens.coefficients)
    if _is_same(depth, color, SIMILAR) and has_equal_lens and np.allclose(T_color_depth, np.eye(4), atol=1e-6):
        return plain
    return BagDepth(bag, integer, single, lens, DepthRegistration(depth, color, T_color_depth))


def _has_equal_rectification(topics: Topics) -> bool:
    """Return False if the names of the topics show that only one of color and registered depth is rectified."""
    is_of_color, is_of_depth = is_rectified(topics.color), is_rectified(topics.depth)
    return is_of_color == is_of_depth or (is_of_color and "raw" not in topics.depth)


def _rotation(topics: Topics, color_info: Any) -> Float64:
    """Return the rotation (4, 4) from registered depth to color, which differ if only one of them is rectified."""
    if _has_equal_rectification(topics):
        return np.eye(4)
    T_rectified_raw = rectification(color_info)
    return T_rectified_raw if is_rectified(topics.color) else inverse(T_rectified_raw)


def _is_same(depth: Camera, color: Camera, tolerance: float) -> bool:
    scale = color.width / depth.width
    of_depth = np.array([depth.fx, depth.fy, depth.cx + 0.5, depth.cy + 0.5]) * scale
    of_color = np.array([color.fx, color.fy, color.cx + 0.5, color.cy + 0.5])
    has_proportions = abs(depth.height * scale / color.height - 1) <= SAME_PROPORTIONS
    return has_proportions and bool((np.abs(of_depth - of_color) <= tolerance * color.width).all())


def _check_proportions(bag: RosBag, topic: str, color: Camera) -> None:
    """Raise DataError if the first depth image does not have the aspect ratio of color."""
    message = next(bag.messages([topic]), None)
    if message is None:
        return
    try:
        height, width = decode_ros_depth(topic, bag.decoded(message)).shape
    except FrameError:
        return  # a damaged image is counted when the frame is read
    if abs(width * color.height / (height * color.width) - 1) > SAME_PROPORTIONS:
        raise DataError(
            f"{bag.path}: {topic}: expected the aspect ratio of color ({color.width}x{color.height} px), got depth of "
            f"{width}x{height} px, which is not registered to color; record its CameraInfo and /tf_static, or {FIX}"
        )


def _integer_unit(bag: RosBag, topics: Topics) -> float:
    """Return the unit of integer depth images, m."""
    if topics.depth.startswith(REALSENSE):
        sensor = topics.depth.partition(DEPTH_STREAM)[0]
        for name in ("Depth Units", "Depth_Units"):
            unit = bag.first(f"{sensor}/option/{name}/value")
            if unit is not None and np.isfinite(unit.data) and unit.data > 0:
                return float(unit.data)
    return MILLIMETER
