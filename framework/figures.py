"""`python -m framework.figures DIR...`: the pictures of experiments, also while a sweep still runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.command_line import one_line_errors
from framework.reports.figures import write_figure


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m framework.figures",
        description="Writes figure.png and figure.pdf into DIR, from the records of the experiment's runs below it.",
    )
    parser.add_argument("directory", metavar="DIR", nargs="+", type=Path, help="where an experiment's runs went")
    asked = parser.parse_args()
    with one_line_errors():
        for directory in asked.directory:
            for path in write_figure(directory):
                print(path)


if __name__ == "__main__":
    main()
