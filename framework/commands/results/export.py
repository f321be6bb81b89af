"""`instancemap export RUN [--to glb usd ...]`: export a run to the formats of other programs."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors


def main() -> None:
    """Run the command `instancemap export`."""
    parser = argparse.ArgumentParser(
        description="Export a run to the formats of other programs: the scene, separate objects (upright, at the "
        "origin, in meters), a floor plan or a scene graph."
    )
    add = parser.add_argument
    formats = ("glb", "ply", "usd", "obj", "floorplan", "graph")
    add("run", metavar="RUN", type=Path, help="run directory, complete or partial")
    add("--to", nargs="+", default=["glb"], choices=formats, help="one or several formats; default: glb")
    add("--out", metavar="DIR", type=Path, help="output folder; default: RUN/export")
    only = "object id or class to export; repeatable"
    add("--object", metavar="OBJECT", action="append", default=[], help=only)
    least = "minimum confidence of exported objects, ignored for explicit ids; default: 0.3"
    add("--min-confidence", metavar="P", type=float, default=0.3, help=least)
    add("--up", metavar=("X", "Y", "Z"), nargs=3, type=float, help="up direction, if the run has none")
    add("--floor", metavar="M", type=float, help="floor height along the up direction, m, if the run has none")
    add = parser.add_argument_group("surfaces").add_argument
    add("--triangles", metavar="N", type=int, help="maximum number of triangles of the scene and of each object file")
    colors = ("appearance", "instance", "class")
    add("--colors", choices=colors, default="appearance", help="vertex colors; default: appearance")
    add("--collision", choices=("hull", "box"), default="hull", help="collision shape of objects in USD; default: hull")
    add = parser.add_argument_group("floor plan and ROS map").add_argument
    add("--resolution", metavar="M", type=float, default=0.05, help="cell size, m; default: 0.05")
    height = "robot height, m: free cells are observed empty up to this height above the floor; default: 1"
    add("--robot-height", metavar="M", type=float, default=1.0, help=height)
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.exporting.exports import Chosen, ExportFormat, export  # slow import

        chosen = Chosen.named(
            parsed.object,
            min_confidence=parsed.min_confidence,
            triangles=parsed.triangles,
            coloring=parsed.colors,
            collision=parsed.collision,
            resolution=parsed.resolution,
            robot_height=parsed.robot_height,
        )
        for path in export(parsed.run, map(ExportFormat, parsed.to), parsed.out, chosen, parsed.up, parsed.floor):
            print(path)
