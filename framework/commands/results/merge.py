"""`instancemap merge RUN_A RUN_B`: merge the overlapping maps of two stored runs."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np

from framework.commands.command_line import arguments, one_line_errors
from framework.geometry import rotation_angle


def main() -> None:
    """Run the command `instancemap merge`."""
    parser = argparse.ArgumentParser(
        description="Merge the overlapping maps of two runs, and write a new run directory with the merged "
        "map in the world frame of the first run. The transform between the runs is found from their keyframes and "
        "surfaces, unless both are known to have the same world frame."
    )
    parser.add_argument("first", metavar="RUN_A", type=Path, help="run directory; its instances keep their ids")
    parser.add_argument("second", metavar="RUN_B", type=Path, help="run directory of the map to add")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="new run directory; default: RUN_A_merged, next to RUN_A"
    )
    parsed = arguments(parser)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.editing.merged_run import MergedRun  # slow import
        from framework.editing.opened_run import check_empty, directory_next_to

        out = parsed.out or directory_next_to(parsed.first, "merged")
        check_empty(out)  # before the slow steps
        merged = MergedRun.of(parsed.first, parsed.second)
        merged.write(out)
        T = merged.T_first_second
        shift = " ".join(f"{value:.3f}" for value in T[:3, 3])
        print(f"transform of {parsed.second}: ({shift}) m, {np.degrees(rotation_angle(T[:3, :3])):.2f} degrees")
        print(f"{merged.shared} instances of both maps merged")
        print(out)
