"""`python -m framework import SOURCE DIR`: a phone's or a sensor's recording as a folder for `dataset=rgbd_folder`."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.importing.bags.ros_topics import Topics
from framework.importing.folder_writer import LONGER_SIDE, Writing, check_new, write_folder
from framework.importing.formats import FORMATS, open_source
from framework.importing.phones.image_rotation import QUARTER, upright


def main() -> None:
    default = Writing()
    listed = "\n".join(f"  {kind.name:<15} {kind.needs}" for kind in FORMATS)
    parser = argparse.ArgumentParser(
        description="Writes a recording of a phone or a sensor as an RGB-D folder, which dataset=rgbd_folder maps.\n"
        f"SOURCE is one of these, and says itself which:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the folder or file that the app exported")
    parser.add_argument("directory", metavar="DIR", type=Path, help="a new or empty folder")
    parser.add_argument(
        "--width",
        type=int,
        default=default.width,
        help=f"of the images, px; default: {LONGER_SIDE} for the longer side",
    )
    parser.add_argument("--stride", type=int, default=default.stride, help="take every so many-th frame, default: 1")
    parser.add_argument(
        "--confidence",
        type=int,
        default=default.confidence,
        help="0 low, 1 medium, 2 high: depth of which a phone is less sure is left out, default: 1",
    )
    parser.add_argument(
        "--turn", type=int, default=default.turn, help="the images, by 90, 180 or 270 degrees clockwise, default: 0"
    )
    bag = parser.add_argument_group("of a ROS bag, where types and names do not say which")
    bag.add_argument("--color", metavar="TOPIC", default="", help="colour images")
    bag.add_argument("--depth", metavar="TOPIC", default="", help="depth images")
    bag.add_argument("--camera-info", metavar="TOPIC", default="", help="the colour camera's intrinsics")
    bag.add_argument("--poses", metavar="TOPIC", default="", help="nav_msgs/Odometry or geometry_msgs/PoseStamped")
    asked = arguments(parser)
    with one_line_errors():
        writing = Writing(asked.width, asked.stride, asked.confidence, asked.turn)
        check_new(asked.directory)
        topics = Topics(asked.color, asked.depth, asked.camera_info, asked.poses)
        source = open_source(asked.source, topics)
        written = write_folder(source, asked.directory, writing)
        root = asked.directory.resolve()
        print(f"{root}: from {source.format}, {written}")
        best = upright(written.ups)
        if best is not None and best != writing.turned:
            degrees = QUARTER * best.quarters
            print(
                f"up is not up in these images, and detectors find little in them; --turn {degrees} turns them upright"
            )
        print(f"check it: python -m framework check dataset=rgbd_folder dataset.root={root}")
        print(f"map it: python -m framework dataset=rgbd_folder dataset.root={root}")
