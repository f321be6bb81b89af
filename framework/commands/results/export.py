"""`instancemap export RUN [--to glb usd ...]`: export a run to standard 3D and map formats."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors


def main() -> None:
    """Run the command `instancemap export`."""
    parser = argparse.ArgumentParser(
        description="Export the scene, individual objects (upright, at the origin, in meters), a floor plan or a "
        "scene graph to standard file formats."
    )
    add = parser.add_argument
    formats = ("glb", "ply", "usd", "obj", "floorplan", "graph", "scannet", "npz")
    add("run", metavar="RUN", type=Path, help="run directory, complete or partial")
    listed = (
        f"one or more of {', '.join(formats)}; floorplan also writes the ROS map; scannet and npz are predictions for "
        "benchmarks; default: glb"
    )
    add("--to", metavar="FORMAT", nargs="+", default=["glb"], choices=formats, help=listed)
    add("--out", metavar="DIR", type=Path, help="output folder; default: RUN/export")
    only = "id or class of the exported objects; repeatable; default: all objects"
    add("--object", metavar="OBJECT", action="append", default=[], help=only)
    least = "minimum probability that an exported object exists, in [0, 1]; ignored for explicit ids; default: 0.5"
    add("--min-probability", metavar="P", type=float, default=0.5, help=least)
    up = "up direction in the world frame; default: up direction of the run"
    add("--up", metavar=("X", "Y", "Z"), nargs=3, type=float, help=up)
    floor = "floor height along the up direction, m; default: floor height of the run, or unknown with --up"
    add("--floor", metavar="M", type=float, help=floor)
    add = parser.add_argument_group("surfaces").add_argument
    most = "approximate number of triangles of the scene, and maximum of each object file, >= 4; default: no limit"
    add("--triangles", metavar="N", type=int, help=most)
    colors = ("appearance", "instance", "class")
    add("--colors", choices=colors, default="appearance", help="vertex colors; default: appearance")
    add("--collision", choices=("hull", "box"), default="hull", help="collision shape of objects in USD; default: hull")
    add = parser.add_argument_group("floor plan and ROS map").add_argument
    add("--resolution", metavar="M", type=float, default=0.05, help="side of a cell, m, in [0.01, 1]; default: 0.05")
    height = "robot height, m, in [0.1, 3]; cells are free if observed empty up to this height; default: 1"
    add("--robot-height", metavar="M", type=float, default=1.0, help=height)
    add = parser.add_argument_group("predictions for benchmarks").add_argument
    space = (
        "label space: nyu40, scannet20, scannet200, agnostic, or a JSON file with the name of each class id; default: "
        "label space of the evaluation if it is one of these names, otherwise scannet20"
    )
    add("--label-space", metavar="SPACE", help=space)
    points = "PLY or NPY file with the labeled points, in the world frame of the dataset; default: ground-truth points"
    add("--points", metavar="FILE", type=Path, help=points)
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.exporting.exports import Chosen, ExportFormat, export  # slow import

        chosen = Chosen.named(
            parsed.object,
            min_probability=parsed.min_probability,
            triangles=parsed.triangles,
            coloring=parsed.colors,
            collision=parsed.collision,
            resolution=parsed.resolution,
            robot_height=parsed.robot_height,
            label_space=parsed.label_space,
            points=parsed.points,
        )
        for path in export(parsed.run, map(ExportFormat, parsed.to), parsed.out, chosen, parsed.up, parsed.floor):
            print(path)
