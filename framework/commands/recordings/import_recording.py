"""`instancemap import SOURCE DIR`: convert a phone or sensor recording to an RGB-D folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.config.text_values import typed
from framework.files.folders.restartable_folder import check_startable
from framework.importing.bags.ros_topics import NO_POSES, BagOptions, Topics
from framework.importing.folder_writer import COMMAND, LONGER_SIDE, ODOMETRY, Writing, write_folder
from framework.importing.formats import FORMATS, open_source
from framework.importing.phones.image_rotation import QUARTER, upright
from framework.importing.source import without_poses


def main() -> None:
    """Run the command `instancemap import`."""
    default = Writing()
    listed = "\n".join(f"  {kind.name:<16} {kind.needs}" for kind in FORMATS)
    parser = argparse.ArgumentParser(
        description="Convert a phone or sensor recording to an RGB-D folder for dataset=rgbd_folder.\n"
        f"The format of SOURCE is detected. Supported formats:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("source", metavar="SOURCE", type=Path, help="recording: a folder or file in a supported format")
    add(
        "directory",
        metavar="DIR",
        type=Path,
        help="output RGB-D folder; must be new, empty or from an interrupted import",
    )
    width = f"image width before rotation, px; default: {LONGER_SIDE} px for the longer side"
    add("--width", metavar="PX", type=int, default=default.width, help=width)
    step = "step between imported frames, in frames; 1 = every frame; default: 1"
    add("--stride", metavar="N", type=int, default=default.stride, help=step)
    confidence = "minimum depth confidence of phone recordings: 0 (low), 1 (medium), 2 (high); default: 1"
    add("--confidence", metavar="LEVEL", type=int, default=default.confidence, help=confidence)
    rotation = "clockwise image rotation, degrees: 90, 180 or 270; default: no rotation"
    add("--rotate", metavar="DEGREES", type=int, default=default.rotate, help=rotation)
    add = parser.add_argument_group("ROS bag topics (default: detected by type and name)").add_argument
    add("--color", metavar="TOPIC", default="", help="color images")
    add("--depth", metavar="TOPIC", default="", help="depth images")
    add("--camera-info", metavar="TOPIC", default="", help="intrinsics of the color camera")
    poses = (
        "camera poses: /tf, or a topic of type PoseStamped, PoseWithCovarianceStamped, Path (optical axes), Odometry "
        "or TransformStamped (of the camera, or of a frame that /tf_static connects with the camera); "
        f"{NO_POSES}: import without poses (all formats)"
    )
    add("--poses", metavar="TOPIC", default="", help=poses)
    odometry = (
        f"odometry, of a type listed for --poses; written to {ODOMETRY} for dataset.odometry, as camera poses if "
        "/tf_static contains the transform; default: none"
    )
    add("--odometry", metavar="TOPIC", default="", help=odometry)
    add = parser.add_argument_group("ROS bag contents (default: as recorded)").add_argument
    bag = BagOptions()
    difference = (
        "maximum time between a color image and its depth image, s; default: half the frame interval of the faster "
        "camera, in [0.02, 0.2] s"
    )
    add("--max-difference", metavar="S", type=float, default=bag.max_difference, help=difference)
    unit = "unit of the depth images, m; default: as recorded (RealSense), otherwise 0.001 for integers, 1 for floats"
    add("--depth-unit", metavar="M", type=float, default=bag.depth_unit, help=unit)
    registered = "assume that depth is registered to color"
    add("--depth-registered", action="store_true", help=registered)
    mounting = 'pose of the camera in the frame of the poses, "TX TY TZ QX QY QZ QW", m; default: from /tf_static'
    add("--camera-pose", metavar="POSE", default=bag.camera_pose, help=mounting)
    parsed = arguments(parser)
    with one_line_errors():
        writing = Writing(parsed.width, parsed.stride, parsed.confidence, parsed.rotate)
        check_startable(parsed.directory, COMMAND)
        topics = Topics(parsed.color, parsed.depth, parsed.camera_info, parsed.poses, parsed.odometry)
        options = BagOptions(parsed.max_difference, parsed.depth_unit, parsed.depth_registered, parsed.camera_pose)
        source = open_source(parsed.source, topics, options)
        if parsed.poses == NO_POSES:
            source = without_poses(source)
        written = write_folder(source, parsed.directory, writing)
        root = parsed.directory.resolve()
        print(f"{root}: from {source.format}, {written}")
        best = upright(written.ups)
        if best is not None and best != writing.turned:
            degrees = QUARTER * best.quarters
            fix = f"import into another folder with --rotate {degrees}"
            print(f"the images are not upright, which reduces detection accuracy; {fix}")
        dataset = f"dataset=rgbd_folder {typed('dataset.root', root)}"
        print(f"check it: instancemap check {dataset}")
        prior = f" {typed('dataset.odometry', root / ODOMETRY)}" if source.odometry else ""
        print(f"map it: instancemap {dataset}{prior}")
