"""`python -m framework export RUN [--to glb usd ...]`: what a run found, in the formats of other programs."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Writes a run's scene, its objects by themselves (upright, standing on the origin, metres), a "
        "floor plan or a scene graph in the formats of other programs.",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="the directory of a run, also of one that ended early")
    parser.add_argument(
        "--to",
        nargs="+",
        default=["glb"],
        choices=("glb", "ply", "usd", "obj", "floorplan", "graph"),
        help="one or several, default: glb",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="where the files go, default: RUN/export")
    parser.add_argument(
        "--object",
        metavar="OBJECT",
        action="append",
        default=[],
        help="an id, or a class for all of it: these objects only; may be given several times",
    )
    parser.add_argument(
        "--min-confidence", metavar="P", type=float, default=0.3, help="of objects, default: 0.3; an id is not asked"
    )
    parser.add_argument("--up", metavar=("X", "Y", "Z"), nargs=3, type=float, help="where the run does not tell")
    parser.add_argument("--floor", metavar="M", type=float, help="how high the floor is along up, likewise")
    surfaces = parser.add_argument_group("surfaces")
    surfaces.add_argument(
        "--triangles", metavar="N", type=int, help="of the scene, and of each object's own file: fewer by decimation"
    )
    surfaces.add_argument(
        "--colors", choices=("appearance", "instance", "class"), default="appearance", help="what colours tell"
    )
    surfaces.add_argument(
        "--collision", choices=("hull", "box"), default="hull", help="what objects collide by, in USD; default: hull"
    )
    plans = parser.add_argument_group("floor plan and ROS map")
    plans.add_argument("--resolution", metavar="M", type=float, default=0.05, help="side of a cell, default: 0.05")
    plans.add_argument(
        "--robot-height",
        metavar="M",
        type=float,
        default=1.0,
        help="free is where nothing is, and all was seen to be empty, up to this height above the floor, default: 1",
    )
    asked = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.exporting.exports import Chosen, ExportFormat, export  # here: wrong arguments are told at once

        chosen = Chosen.named(
            asked.object,
            min_confidence=asked.min_confidence,
            triangles=asked.triangles,
            coloring=asked.colors,
            collision=asked.collision,
            resolution=asked.resolution,
            robot_height=asked.robot_height,
        )
        for path in export(asked.run, map(ExportFormat, asked.to), asked.out, chosen, asked.up, asked.floor):
            print(path)
