"""`python -m framework ranks DIR DIR...`: whether the rows of an experiment rank alike in several places."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.tables.ranks import write_ranks

FIGURE = "instances.ap50"


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Compares experiments with the same rows in several places, from the records below their folders: "
        "each row's mean and rank in each place, and Spearman's rho between places, with its bootstrap intervals.",
    )
    parser.add_argument(
        "directory",
        metavar="DIR",
        nargs="+",
        type=Path,
        help="where an experiment's runs went; of three or more, the first is also compared with the others' mean",
    )
    parser.add_argument(
        "--figure", metavar="KEY", nargs="+", default=[FIGURE], help=f"keys of metrics.json, a table each ({FIGURE})"
    )
    parser.add_argument("--out", metavar="FOLDER", type=Path, help="write ranks.md and ranks.csv there, too")
    asked = arguments(parser)
    with one_line_errors():
        print(write_ranks(asked.directory, asked.figure, asked.out), end="")
