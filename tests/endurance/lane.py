"""The endurance run: visits of all places, the page, and the bounds that are not met."""

from __future__ import annotations

import argparse
import sys
import tempfile
from datetime import date
from math import ceil
from pathlib import Path

from framework.commands.command_line import EXIT_FAILED, arguments, one_line_errors
from framework.errors import ConfigError
from tests.acceptance.runner import CHECKOUT, commit_of, machine
from tests.endurance.growth import Verdict, verdicts
from tests.endurance.places import places_of
from tests.endurance.results_page import write_page
from tests.endurance.visits import visit_all
from tests.support.reference_time import Reference

FRAMES = 10_000
MIN_FRAMES = 112  # one frame for each block
MIN_VISITS = 7  # with 10,000 frames, three of them before the first tentative instances expire
MAX_ROUND = 2_400  # frames, maximum for one visit of each place: the recordings have 300 frames, forward and backward
CODE = ("framework", "plugins", "conf", "tests/endurance")


def main() -> None:
    """Run `python -m tests.endurance`."""
    parser = argparse.ArgumentParser(prog="python -m tests.endurance", description=__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"number of frames (default: {FRAMES})")
    parser.add_argument(
        "--out", metavar="FOLDER", type=Path, default=CHECKOUT / "docs" / "results", help="folder of the page"
    )
    options = arguments(parser)
    with one_line_errors():
        missed = [verdict for verdict in run(options.frames, options.out) if not verdict.is_met]
    for verdict in missed:
        print(verdict, file=sys.stderr)
    sys.exit(EXIT_FAILED if missed else 0)


def run(frames: int, folder: Path) -> list[Verdict]:
    """Map about `frames` frames, write the page into the folder, and return the comparisons with the bounds.

    Raises:
        ConfigError: The number of frames is too small, or the C library is not glibc.
        DataError: A recording cannot be read.
    """
    if frames < MIN_FRAMES:
        raise ConfigError(f"--frames: expected at least {MIN_FRAMES}, got {frames}; map more frames")
    visits = max(MIN_VISITS, ceil(frames / MAX_ROUND))
    with tempfile.TemporaryDirectory() as detections:
        places = places_of(visits, frames, Path(detections))
        blocks = list(visit_all(places, visits, Reference(places[0].frame(0))))
    found = verdicts(blocks)
    provenance = f"Commit {commit_of(CODE)}, {date.today()}, {machine()}."
    print(write_page(folder, blocks, found, provenance))
    return found
